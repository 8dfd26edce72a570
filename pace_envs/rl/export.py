"""A policy as files for other programs: TorchScript, ONNX, and what its numbers mean."""

from __future__ import annotations

import json
import logging
import tempfile
import warnings
from pathlib import Path
from typing import Any

from pace_actuators.files import write_together
from pace_envs.rl.runner import PaceOnPolicyRunner

EXPORTED = "exported"
"""Folder of a training's run that its policy is exported to."""


def exported_files(folder: Path) -> list[Path]:
    """The files of an exported policy."""
    return [folder / name for name in ("policy.pt", "policy.onnx", "policy.json")]


def export_policy(runner: PaceOnPolicyRunner, folder: Path) -> None:
    """Write ``policy.pt`` (TorchScript), ``policy.onnx`` and ``policy.json`` (observations, joints, targets, rate).

    Both take the observation (batch, dim), normalise it themselves, and give the mean action (batch, joints).
    """
    import onnx  # heavy, and only needed here

    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)  # it misses torchvision, which is not needed here
    with tempfile.TemporaryDirectory() as made:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of both exporters' own deprecations
                runner.export_policy_to_jit(made)
                runner.export_policy_to_onnx(made)
        finally:
            log.setLevel(level)
        policy = Path(made, "policy.pt").read_bytes()
        network = onnx.load_model(Path(made, "policy.onnx")).SerializeToString()  # the weights inside
    text = json.dumps(describe_policy(runner), indent=2) + "\n"
    folder.mkdir(parents=True, exist_ok=True)
    write_together(dict(zip(exported_files(folder), (policy, network, text.encode()), strict=True)))


def describe_policy(runner: PaceOnPolicyRunner) -> dict[str, Any]:
    """What a policy's numbers mean; those of several action terms by their names, in the order of the action."""
    env = runner.env.unwrapped
    robot = env.scene["robot"]
    terms = []
    for name, (term, dim) in env.observation_manager.group_terms("policy").items():
        terms.append({"name": name, "dim": dim, "scale": 1.0 if term.scale is None else term.scale})
    manager = env.action_manager
    actions = {name: manager.get_term(name).describe() for name in manager.active_terms}
    return {
        "version": 1,
        "step_dt": env.step_dt,
        "observations": terms,
        **(next(iter(actions.values())) if len(actions) == 1 else {"actions": actions}),
        "default_joint_pos": robot.data.default_joint_pos[0].tolist(),
    }
