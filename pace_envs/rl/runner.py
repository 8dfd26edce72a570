"""rsl-rl's runner with what this project adds: threads, the curriculum's state in checkpoints."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from rsl_rl.runners import OnPolicyRunner
from rsl_rl.utils.logger import Logger
from tensordict import TensorDict

from pace_actuators.files import read_tensors, replacing
from pace_actuators.files.reading import tensors_in
from pace_envs.mdp import UniformVelocityCommand
from pace_envs.rsl_rl_wrapper import RslRlVecEnvWrapper
from pace_envs.simulation import available_processors

_MOST = sys.float_info.max
_CURE = "Name a model_<iteration>.pt that scripts/train.py wrote."
_MOST_THREADS = 8  # for networks this small


class PaceOnPolicyRunner(OnPolicyRunner):
    """Trains a policy.

    Two kinds of work take turns on the same cores. While samples are collected the physics has a thread per core, and
    torch's tensors are so small that one thread is fastest; while the networks learn the physics rests and torch takes
    ``learning_threads``. Set ``OMP_WAIT_POLICY=PASSIVE`` before torch is imported: threads that spin while they wait
    make an update ten times slower where other programs want the cores, too.
    """

    env: RslRlVecEnvWrapper

    def __init__(
        self, env: RslRlVecEnvWrapper, train_cfg: dict, log_dir: str | None = None, learning_threads: int | None = None
    ):
        """Build the networks; ``learning_threads`` defaults to the number of processors, up to 8."""
        on_gpu = env.device.type == "cuda"
        if on_gpu:  # rsl-rl would wait for the GPU at every step; an episode that diverges ends by itself
            train_cfg = {"check_for_nan": False, **train_cfg}
        super().__init__(env, train_cfg, log_dir, device=str(env.device))
        if on_gpu:
            DeferredEpisodes(self.logger)
        self.logger.git_status_repos.clear()  # no copy of uncommitted work in every run
        self.learning_threads = learning_threads or min(available_processors(), _MOST_THREADS)
        self.alg.update = _with_threads(self.alg.update, self.learning_threads)

    def _configure_multi_gpu(self) -> None:
        """Join torchrun's other processes: rsl-rl's own way on GPUs, by gloo on processors."""
        if str(self.device) != "cpu" or int(os.environ.get("WORLD_SIZE", "1")) == 1:
            super()._configure_multi_gpu()
            return
        count, rank = int(os.environ["WORLD_SIZE"]), int(os.environ["RANK"])
        self.gpu_world_size, self.gpu_global_rank, self.is_distributed = count, rank, True
        self.gpu_local_rank = int(os.environ.get("LOCAL_RANK", "0"))
        self.cfg["multi_gpu"] = {"global_rank": rank, "local_rank": self.gpu_local_rank, "world_size": count}
        if not torch.distributed.is_initialized():
            torch.distributed.init_process_group("gloo", rank=rank, world_size=count)

    def save(self, path: str, infos: dict | None = None) -> None:
        """Save networks, optimizer and the curriculum's state, whole or not at all."""
        with replacing(Path(path)) as part:
            super().save(str(part), {**(infos or {}), "env": self._env_state()})

    def load(
        self, path: str, load_cfg: dict | None = None, strict: bool = True, map_location: str | None = None
    ) -> dict:
        """Load a checkpoint; training goes on with the iteration after it."""
        if not Path(path).is_file():
            raise ValueError(f"The checkpoint {path} does not exist.")
        content = read_checkpoint(path)  # wherever it was trained
        before = [dict(group) for group in self.alg.optimizer.param_groups]
        try:
            if self.alg.load(content, load_cfg, strict):
                self.current_learning_iteration = int(content["iter"])
            self._check_networks()
            infos = content["infos"] or {}
            scales = dict(infos.get("env", {}).get("command_scale", {}))
            _check_optimizer(self.alg.optimizer, before)
            if self.env.unwrapped.curriculum_manager.active_terms:
                for name, scale in scales.items():
                    self._velocity_commands()[name].scale = _finite(scale, f"command_scale/{name}")
        except (RuntimeError, KeyError, IndexError, AttributeError, TypeError, ValueError) as error:
            first = (str(error) or type(error).__name__).splitlines()[0]
            raise ValueError(f"{path} is no checkpoint of this task's networks ({first}). Check --task.") from None
        self.current_learning_iteration += 1
        return infos

    def _check_networks(self) -> None:
        """See whether the networks have outputs: a weight that the file can hold may be none in single precision."""
        sizes = self.env.unwrapped.observation_manager.group_obs_dim
        observations = {name: torch.ones(1, *size, device=self.device) for name, size in sizes.items()}
        for network in (self.alg.actor, self.alg.critic):
            with torch.inference_mode():
                values = [*network.state_dict().values(), network(TensorDict(observations, batch_size=[1]))]
            if not all(bool(value.isfinite().all()) for value in values):
                raise ValueError("what they say is not finite")

    def _env_state(self) -> dict[str, Any]:
        return {"command_scale": {name: term.scale for name, term in self._velocity_commands().items()}}

    def _velocity_commands(self) -> dict[str, UniformVelocityCommand]:
        manager = self.env.unwrapped.command_manager
        terms = {name: manager.get_term(name) for name in manager.active_terms}
        return {name: term for name, term in terms.items() if isinstance(term, UniformVelocityCommand)}


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """The content of a checkpoint: numbers and tensors, and nothing that would run code to be read."""
    try:
        content = read_tensors(path, _CURE)
    except ValueError as error:
        raise ValueError(f"The checkpoint {error}") from None
    if not isinstance(content, dict):
        raise ValueError(
            f"The checkpoint {path} holds a {type(content).__name__}, expected that of a training. {_CURE}"
        )
    for key, tensor in tensors_in(content):
        if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
            raise ValueError(f"The checkpoint {path}: {key} holds values that are no numbers. {_CURE}")
    return content


def _finite(value: Any, what: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= _MOST:
        raise ValueError(f"{what} is {value!r:.40}")
    return value


_ADAM = {"step", "exp_avg", "exp_avg_sq"}
"""What Adam keeps of a parameter."""


def _check_optimizer(optimizer: torch.optim.Optimizer, before: list[dict[str, Any]]) -> None:
    """See whether what was loaded can be gone on with: the optimizer itself looks when it steps."""
    for group, own in zip(optimizer.param_groups, before, strict=True):
        for key, value in own.items():
            found = group[key]
            if key == "params":
                continue
            if type(found) is not type(value) or (isinstance(found, float) and not 0.0 <= found < math.inf):
                raise ValueError(f"the optimizer's {key} is {found!r:.40}")
        for parameter in group["params"]:
            state = optimizer.state.get(parameter, {})
            if state and isinstance(optimizer, torch.optim.Adam) and (missing := _ADAM - state.keys()):
                raise ValueError(f"the optimizer's {missing.pop()} is missing")
            for key, value in state.items():
                if isinstance(value, torch.Tensor) and value.shape not in ((), parameter.shape):
                    raise ValueError(f"the optimizer's {key} has the shape {tuple(value.shape)}")
                if not isinstance(value, torch.Tensor) or not value.isfinite().all():
                    raise ValueError(f"the optimizer's {key} is no number")


def _with_threads(update: Callable[[], dict], threads: int) -> Callable[[], dict]:
    def run() -> dict:
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        try:
            return update()
        finally:
            torch.set_num_threads(before)

    return run


class DeferredEpisodes:
    """Notes on the GPU which episodes end, and looks at them once an iteration, when they are logged.

    rsl-rl's own looks after every step, and the GPU idles until the next step is queued.
    """

    def __init__(self, logger: Logger):
        """Take the place of the logger's own methods."""
        self._logger = logger
        self._log, self._process = logger.log, logger.process_env_step
        self._ended: list[tuple[torch.Tensor, torch.Tensor, torch.Tensor]] = []
        logger.log, logger.process_env_step = self.log, self.process_env_step

    def process_env_step(
        self,
        rewards: torch.Tensor,
        dones: torch.Tensor,
        extras: dict[str, Any],
        intrinsic_rewards: torch.Tensor | None = None,
    ) -> None:
        """Note a step, as rsl-rl's logger does."""
        logger = self._logger
        if logger.writer is None or intrinsic_rewards is not None:
            self._process(rewards, dones, extras, intrinsic_rewards)
            return
        if "log" in extras:
            logger.ep_extras.append(extras["log"])
        logger.cur_reward_sum += rewards
        logger.cur_episode_length += 1
        done = dones > 0
        self._ended.append((done, logger.cur_reward_sum.clone(), logger.cur_episode_length.clone()))
        logger.cur_reward_sum.masked_fill_(done, 0)
        logger.cur_episode_length.masked_fill_(done, 0)

    def log(self, *args: Any, **kwargs: Any) -> None:
        """Look at the episodes that have ended, and log the iteration."""
        if self._ended:
            done, reward, length = (torch.stack(each) for each in zip(*self._ended, strict=True))
            self._logger.rewbuffer.extend(reward[done].tolist())
            self._logger.lenbuffer.extend(length[done].tolist())
            self._ended.clear()
        self._log(*args, **kwargs)
