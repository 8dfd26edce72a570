"""Make recordings with known parameters in simulation, or write the commands for a real robot."""

import sys

from pace_optim.cli import run_cli
from pace_optim.data_collection import cfg_from_args, collect, make_collection_parser


def main() -> None:
    collection = collect(cfg_from_args(make_collection_parser().parse_args()))
    for warning in collection.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    for kind in ("recordings", "commands", "plots"):
        for path in getattr(collection, kind):
            print(f"{kind[:-1]}: {path}")


if __name__ == "__main__":
    sys.exit(run_cli(main))
