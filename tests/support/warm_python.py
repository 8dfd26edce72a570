"""A ``python`` that starts at once: a process that has imported the libraries and our packages forks for each command.

Importing torch, SciPy, MuJoCo and our packages takes three seconds, of which most commands of the tests spend most of
their time. The command itself runs as in a process of its own: its folder, environment and streams are those of who
started it. What is read while a library is imported (``OMP_NUM_THREADS``, ``OPENBLAS_CORETYPE``) is the server's.
"""

import contextlib
import io
import json
import os
import runpy
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import traceback
from collections.abc import Iterator
from pathlib import Path

CLIENT = """
import json, os, socket, sys
with socket.socket(socket.AF_UNIX) as server:
    server.connect(sys.argv[1])
    said = json.dumps([sys.argv[2:], os.getcwd(), dict(os.environ)]).encode()
    socket.send_fds(server, [len(said).to_bytes(8, "big")], [0, 1, 2])
    server.sendall(said)
    sys.exit(int(server.recv(8) or b"1"))
"""

PACE = "import sys; from pace_optim.commands import main; sys.exit(main())"

IMPORTED = (
    "gymnasium",
    "matplotlib.backends.backend_agg",
    "matplotlib.figure",
    "mujoco",
    "scipy.optimize",
    "scipy.signal",
    "scipy.stats",
    "torch.distributed",
    "torch.utils.tensorboard",
    "pace_actuators.effects",
    "pace_envs.rl",
    "pace_optim.commands.compare",
    "pace_optim.commands.data_collection",
    "pace_optim.commands.diagnose",
    "pace_optim.commands.fit",
    "pace_optim.comparison.compare",
    "pace_optim.diagnosis.diagnose",
    "pace_optim.export",
    "pace_optim.identification.fit",
    "pace_optim.report.page",
    "pace_optim.report.plots",
)


class WarmPython:
    """Starts commands: a script, ``-`` (code from standard input) or ``-c CODE``, with their arguments."""

    def __init__(self, client: list[str]):
        """Take the words that a command's words follow."""
        self._client = client

    @property
    def bash(self) -> str:
        """Bash that makes ``python`` and ``pace`` functions."""
        python, pace = shlex.join(self._client), shlex.quote(PACE)
        return f'python() {{ {python} "$@"; }}\npace() {{ {python} -c {pace} "$@"; }}'

    def start(self, *words: object, **options: object) -> subprocess.Popen[str]:
        """As ``subprocess.Popen([sys.executable, *words], text=True, **options)``; its end is the command's end."""
        return subprocess.Popen([*self._client, *map(str, words)], text=True, **options)  # type: ignore[call-overload]

    def run(self, *words: object, **options: object) -> subprocess.CompletedProcess[str]:
        """As ``subprocess.run``, with what is printed."""
        return subprocess.run(  # type: ignore[call-overload]
            [*self._client, *map(str, words)], capture_output=True, text=True, check=False, **options
        )


@contextlib.contextmanager
def warm_python() -> Iterator[WarmPython]:
    """Run a server while this lasts."""
    with tempfile.TemporaryDirectory(prefix="py-") as folder:  # a socket's path is short
        place, client = Path(folder, "socket"), Path(folder, "client.py")
        client.write_text(CLIENT)
        server = subprocess.Popen(
            [sys.executable, __file__, place], stdout=subprocess.PIPE, env={**os.environ, "OMP_NUM_THREADS": "1"}
        )
        try:
            assert server.stdout is not None and server.stdout.readline() == b"ready\n"
            yield WarmPython([sys.executable, "-I", "-S", str(client), str(place)])
        finally:
            server.terminate()
            server.wait()


def _serve(place: str) -> None:
    """Import, and fork for each command."""
    sys.path.pop(0)  # the folder of this file
    for name in IMPORTED:
        __import__(name)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(place)
        listening.listen()
        print("ready", flush=True)
        while True:
            asked, _ = listening.accept()
            if not os.fork():
                listening.close()
                signal.signal(signal.SIGTERM, signal.SIG_DFL)
                _attend(asked)
            asked.close()
            with contextlib.suppress(ChildProcessError):
                while os.waitpid(-1, os.WNOHANG)[0]:
                    pass


def _attend(asked: socket.socket) -> None:
    """Fork the command that a client asks for and report its exit status; it ends with its client."""
    size, streams, *_ = socket.recv_fds(asked, 8, 3)
    with asked.makefile("rb") as file:
        words, home, environ = json.loads(file.read(int.from_bytes(size, "big")))
    command = os.fork()
    if not command:
        asked.close()
        for own, stream in enumerate(streams):
            os.dup2(stream, own)
            os.close(stream)
        os._exit(_run(words, home, environ))
    for stream in streams:
        os.close(stream)

    def end_with_the_client() -> None:
        if not asked.recv(1):
            with contextlib.suppress(ProcessLookupError):
                os.kill(command, signal.SIGKILL)

    threading.Thread(target=end_with_the_client, daemon=True).start()
    status = os.waitstatus_to_exitcode(os.waitpid(command, 0)[1])
    with contextlib.suppress(OSError):
        asked.sendall(str(status).encode())
    os._exit(0)


def _run(words: list[str], home: str, environ: dict[str, str]) -> int:
    """Run a command as ``python`` does; its exit status."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    streams = (io.TextIOWrapper(io.FileIO(at, mode, closefd=False), "utf-8") for at, mode in enumerate(("r", "w", "w")))
    sys.stdin, sys.stdout, sys.stderr = streams
    os.chdir(home)
    os.environ.clear()
    os.environ.update(environ)
    script, sys.argv = words[0], words
    if script == "-c":
        code, sys.argv = words[1], ["-c", *words[2:]]
    paths = [path for path in environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    first = "" if script in ("-", "-c") else os.path.dirname(os.path.abspath(script))
    sys.path[:0] = [first, *(path for path in paths if path not in sys.path)]
    try:
        if script == "-":
            exec(compile(sys.stdin.read(), "<stdin>", "exec"), {"__name__": "__main__"})
        elif script == "-c":
            exec(compile(code, "<string>", "exec"), {"__name__": "__main__"})
        else:
            runpy.run_path(script, run_name="__main__")
        status = 0
    except SystemExit as ended:
        status = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
        if isinstance(ended.code, str):
            print(ended.code, file=sys.stderr)
    except BaseException:
        traceback.print_exc()
        status = 1
    sys.stdout.flush()
    sys.stderr.flush()
    return status


if __name__ == "__main__":
    _serve(sys.argv[1])
