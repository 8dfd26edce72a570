"""A walking task without random draws."""

from pace_envs import load_env_cfg

TASK, NUM_ENVS = "Pace-AnymalD-Velocity-v0", 16


def without_chance():
    """The task with all its random draws fixed, and short episodes."""
    cfg = load_env_cfg(TASK)
    cfg.scene.num_envs, cfg.seed, cfg.episode_length_s = NUM_ENVS, 0, 0.6
    for event in cfg.events.values():
        ranges = {key: value for key, value in event.params.items() if key.endswith("_range")}
        fixed = {k: dict.fromkeys(v, (0.1, 0.1)) if isinstance(v, dict) else (0.05, 0.05) for k, v in ranges.items()}
        event.params = {**event.params, **fixed}
    command = cfg.commands["base_velocity"]
    command.lin_vel_x = command.lin_vel_y = command.ang_vel_z = (0.3, 0.3)
    command.rel_standing_envs = 0.0
    cfg.observations["policy"].enable_corruption = False
    return cfg
