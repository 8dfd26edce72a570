"""A ``python`` that starts at once: a process that holds the libraries, none of our modules, forks for each command.

Importing torch, SciPy and MuJoCo takes two seconds, of which a page that types twenty commands spends most of its time.
The command itself runs as in a process of its own: its folder, environment and streams are those of who typed it.
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


@contextlib.contextmanager
def warm_python() -> Iterator[str]:
    """Bash that makes ``python`` a function: scripts and code from standard input go to a process that is warm."""
    with tempfile.TemporaryDirectory(prefix="py-") as folder:  # a socket's path is short
        place, client = Path(folder, "socket"), Path(folder, "client.py")
        client.write_text(CLIENT)
        server = subprocess.Popen([sys.executable, __file__, place], stdout=subprocess.PIPE)
        try:
            assert server.stdout is not None and server.stdout.readline() == b"ready\n"
            words = shlex.join([sys.executable, "-I", "-S", str(client), str(place)])
            yield f'python() {{ {words} "$@"; }}'
        finally:
            server.kill()
            server.wait()


def _serve(place: str) -> None:
    """Import, and fork for each command."""
    import gymnasium  # noqa: F401
    import matplotlib.figure  # noqa: F401
    import mujoco  # noqa: F401
    import scipy.optimize
    import scipy.signal
    import scipy.stats  # noqa: F401
    import torch  # noqa: F401

    assert not [name for name in sys.modules if name.startswith("pace_")]
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(place)
        listening.listen()
        print("ready", flush=True)
        while True:
            asked, _ = listening.accept()
            size, streams, *_ = socket.recv_fds(asked, 8, 3)
            with asked.makefile("rb") as file:
                words, home, environ = json.loads(file.read(int.from_bytes(size, "big")))
            child = os.fork()
            if not child:
                listening.close()
                asked.close()
                for own, stream in enumerate(streams):
                    os.dup2(stream, own)
                    os.close(stream)
                os._exit(_run(words, home, environ))
            for stream in streams:
                os.close(stream)
            asked.sendall(str(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])).encode())
            asked.close()


def _run(words: list[str], home: str, environ: dict[str, str]) -> int:
    """Run a command as ``python`` does; its exit status."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    streams = (io.TextIOWrapper(io.FileIO(at, mode, closefd=False), "utf-8") for at, mode in enumerate(("r", "w", "w")))
    sys.stdin, sys.stdout, sys.stderr = streams
    os.chdir(home)
    os.environ.clear()
    os.environ.update(environ)
    script, sys.argv = words[0], words
    paths = [path for path in environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    sys.path[0] = "" if script == "-" else os.path.dirname(os.path.abspath(script))
    sys.path[1:1] = [path for path in paths if path not in sys.path]
    try:
        if script == "-":
            exec(compile(sys.stdin.read(), "<stdin>", "exec"), {"__name__": "__main__"})
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
