"""A synthetic diagnosis for the tests of what reads one."""

from __future__ import annotations

from typing import Any

from run_folders import JOINTS


def make_diagnosis(verdict: str = "effect") -> dict[str, Any]:
    """A plausible ``diagnosis.json`` of the folder that ``write_run`` makes."""
    known = verdict == "effect"

    def entry(effect: str, after: float, **changes: Any) -> dict[str, Any]:
        return {
            "effect": effect,
            "round": 1,
            "added": False,
            "joints": list(JOINTS),
            "validation_rmse_before": 4.3e-3,
            "validation_rmse_after": after,
            "significant": False,
            "evidence": f"On recordings not used for fitting the error falls from 4.3 to {1e3 * after:.3g} mrad.",
            "confounded_with": [],
            "screen_score": 0.5,
            "values": {},
        } | changes

    ranking = [
        entry("stribeck_friction", 4e-4, added=known, significant=known, confounded_with=["presliding_friction"]),
        entry("presliding_friction", 4.2e-4, significant=known, confounded_with=["stribeck_friction"]),
        entry("quadratic_friction", 3.9e-3, joints=["knee"]),
    ]
    variables = {"q": 0.2, "v": 0.1, "q·sgn v": 0.8, "|τ|·sgn v": 0.3, "τ": 0.1, "t": -0.1}
    curve = {"at": [-0.4, -0.2, 0.0, 0.2, 0.4], "torque": [-0.2, 0.1, 0.0, -0.1, 0.2]}
    carried = {
        "r2": variables,
        "best": "q·sgn v",
        "best_label": "position × sign of speed [rad]",
        "sentence": "80 % of it follows position × sign of speed.",
        "curve": curve,
    }
    return {
        "version": 1,
        "run": "logs/pace/leg/26_01_01_00-00-00",
        "verdict": verdict,
        "summary": "Missing: stribeck_friction." if known else "The validation error is 4.3 mrad, the floor 0.1 mrad.",
        "added": ["stribeck_friction"] if known else [],
        "ranking": ranking if verdict != "nothing_missing" else [],
        "joints": {
            name: {
                "validation_rmse_before": 4.3e-3,
                "validation_rmse_after": 4e-4,
                "floor": 1e-4,
                "effects": ["stribeck_friction"] if known else [],
            }
            for name in JOINTS
        },
        "data": ["Measurement noise: 0.1 to 0.1 mrad by joint."],
        "advice": [
            "These recordings cannot tell stribeck_friction from presliding_friction. Record: "
            "scripts/data_collection.py --task Pace-Leg-v0 --excitation ramp"
        ],
        "runs": ["logs/pace/leg/26_01_01_00-00-00"],
        "tried": ["stribeck_friction", "presliding_friction", "quadratic_friction", "torque_gain"],
        "physics_dt": 0.00125,
        "ladder": [{"model": "base model", "validation_rmse": 4.3e-3}]
        + [{"model": "stribeck_friction", "validation_rmse": 4e-4}] * known,
        "error_map": {"sentence": "It follows q·sgn v.", "joints": dict.fromkeys(JOINTS, carried)},
        "simulated_steps": 0,
        "wall_time_s": 12.0,
    }
