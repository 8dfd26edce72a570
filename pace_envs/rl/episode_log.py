"""rsl-rl's book keeping of episodes without waiting for the GPU at every step."""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.utils.logger import Logger


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
