"""What test_several_processes.py starts once per rank: a training, shared by gloo."""

import hashlib
import itertools
import os
import sys

from pace_envs.rl import PaceOnPolicyRunner, RunSettings, resume, train, training
from pace_envs.rl.training import process_number
from pace_optim.terminal.cli import run_cli


def main() -> None:
    """Train in a folder, or go on in it, and print what the weights are; the rank named by LOSE ends while learning."""
    command, place = sys.argv[1:]
    learn = PaceOnPolicyRunner.learn

    def learn_and_tell(self: PaceOnPolicyRunner, *args: object, **kwargs: object) -> None:
        update, updates = self.alg.update, itertools.count()

        def update_or_end() -> dict:
            if os.environ.get("LOSE") == str(process_number()) and next(updates):
                os._exit(9)
            return update()

        self.alg.update = update_or_end
        learn(self, *args, **kwargs)
        weights = b"".join(value.numpy().tobytes() for value in self.alg.save()["actor_state_dict"].values())
        print(f"weights: {hashlib.sha256(weights).hexdigest()}")

    PaceOnPolicyRunner.learn = learn_and_tell
    training.export_policy = lambda *_: None  # another test's, and slow
    if command == "resume":
        folder = resume(place)
    else:
        folder = train(RunSettings(task="Pace-AnymalD-Velocity-v0", num_envs=8, max_iterations=2, log_dir=place))
    print(f"run: {folder}")


if __name__ == "__main__":
    sys.exit(run_cli(main))
