"""Training, judging and exporting policies with rsl-rl."""

from pace_envs.rl.evaluation import Evaluation, evaluate
from pace_envs.rl.export import export_policy
from pace_envs.rl.playing import PlaySettings, play
from pace_envs.rl.run_folder import RunSettings, latest_checkpoint
from pace_envs.rl.runner import PaceOnPolicyRunner
from pace_envs.rl.training import load_cfg, make_env, resume, train

__all__ = [
    "Evaluation",
    "PaceOnPolicyRunner",
    "PlaySettings",
    "RunSettings",
    "evaluate",
    "export_policy",
    "latest_checkpoint",
    "load_cfg",
    "make_env",
    "play",
    "resume",
    "train",
]
