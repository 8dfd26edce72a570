"""``pace new-robot`` as a script; ``--help`` tells what it does."""

import sys

from pace_optim.commands.new_robot import main
from pace_optim.terminal.cli import run_cli

if __name__ == "__main__":
    sys.exit(run_cli(main))
