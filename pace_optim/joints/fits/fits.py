"""How models of single joints are simulated and fitted: several side by side, in windows and on whole recordings."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import torch

from pace_actuators.effects import Effect
from pace_envs.compiler import host_kernels, kernels_of
from pace_envs.devices import find_device
from pace_optim.joints.fits.block_errors import BlockErrors, block_errors
from pace_optim.joints.fits.descent import TRIALS, JointDescent
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.fits.fitting_cfg import FittingCfg
from pace_optim.joints.fits.side_by_side import SideBySide, Slot
from pace_optim.joints.simulation.problem import TwinProblem
from pace_optim.terminal.parallel import parallel_map


@dataclass(frozen=True, kw_only=True)
class Fits:
    """Fits models of single joints and computes their errors; the search gets one, and tests give others."""

    cfg: FittingCfg = field(default_factory=FittingCfg)
    batch: Callable[..., SideBySide] = SideBySide
    """Makes what simulates: of a problem, slots, and whether only what is trained on is wanted."""
    on_gpu: bool = False
    """Whether it simulates on a GPU: the more at once, the better."""

    def coarse_to_fine(self, problem: TwinProblem, starts: Sequence[Fitted], rough: bool = False) -> list[Fitted]:
        """Go most of the way in windows at the control step, on at the problem's own, the rest on whole recordings.

        Models that the control step shows to be far behind the best one on every joint stay where it left them.

        Args:
            problem: The joints simulated alone.
            starts: Models and where they start.
            rough: Whether to go on over wide steps where narrow ones have led.
        """
        cfg, coarse = self.cfg, problem.coarse()
        result = self.side_by_side(coarse, starts, cfg.coarse)
        for _ in range(cfg.rounds - 1):
            falling = [near and each.falls for near, each in zip(self._near(result), result, strict=True)]
            result = _again(result, falling, lambda those: self.side_by_side(coarse, those, cfg.coarse))
        if rough:
            wide = self._near(result)
            result = _again(result, wide, lambda those: self.side_by_side(coarse, those, cfg.coarse, rough=True))
        windows = problem.in_windows()
        result = _again(result, self._near(result), lambda those: self.side_by_side(windows, those, cfg.fine))
        return _again(result, self._near(result), lambda those: self.to_whole(problem, those))

    def over_wide_steps(self, problem: TwinProblem, now: Fitted, kept: torch.Tensor | None = None) -> Fitted:
        """A model fitted in windows over wide steps, where narrow ones may lead no further.

        Args:
            problem: The joints simulated alone.
            now: The model.
            kept: Which windows that are trained on count for which joints, (R, n) bool; all if not given.
        """
        return self.side_by_side(problem.in_windows(), [now], self.cfg.coarse, rough=True, kept=kept)[0]

    def to_whole(self, problem: TwinProblem, starts: Sequence[Fitted]) -> list[Fitted]:
        """The last iterations of models that windows have led, on whole recordings."""
        return self.side_by_side(problem, starts, self.cfg.whole, keep_jacobian=True, chords=self.cfg.chords)

    def to_the_end(self, problem: TwinProblem, now: Fitted) -> Fitted:
        """A model on whole recordings, with new derivatives as long as they lower a joint's error."""
        now = self.to_whole(problem, [now])[0]
        for _ in range(self.cfg.rounds - 1):
            before, now = now.score, self.to_whole(problem, [now])[0]
            if bool((now.score > (1 - self.cfg.enough) * before).all()):
                break
        return now

    def looked_at(self, problem: TwinProblem, models: Sequence[Fitted]) -> list[Fitted]:
        """Models where they are, with their errors and derivatives."""
        starts = [Fitted.start(each.model, each.physical, tried=each.tried) for each in models]
        return self.side_by_side(problem, starts, 1, keep_jacobian=True)  # one iteration does not move

    def side_by_side(
        self,
        problem: TwinProblem,
        starts: Sequence[Fitted],
        max_iteration: int,
        keep_jacobian: bool = False,
        part: float = 1.0,
        rough: bool = False,
        kept: torch.Tensor | None = None,
        chords: int = 0,
    ) -> list[Fitted]:
        """Fit several models from their present x, each joint by itself.

        Every iteration simulates, for each model, the favoured step, its neighbours (for the next Jacobian) and steps
        with more damping. Joints do not influence each other, so that one row serves all of them.

        Args:
            problem: The joints simulated alone.
            starts: Models and where they start.
            max_iteration: Largest number of iterations.
            keep_jacobian: Whether the last Jacobian is kept.
            part: Only so much of the beginning of the recordings is simulated.
            rough: Whether derivatives are taken over wide steps first.
            kept: Which of the recordings that are trained on count for which joints, (R, n) bool; all if not given.
            chords: Steps that follow with the kept Jacobian, at most.
        """
        return self.shared_out(
            lambda own: self._fit(problem, own, max_iteration, keep_jacobian, part, rough, kept, chords),
            starts,
            [start.tried for start in starts],
        )

    def shared_out(self, work: Callable[[list], list], items: Sequence, effects: Sequence[type[Effect] | None]) -> list:
        """``work(items)``: by :func:`parallel_map` on a processor, all at once on a GPU."""
        if self.on_gpu:
            return work(list(items))
        return parallel_map(work, items, effects)

    def validation_errors(self, problem: TwinProblem, models: Sequence[Fitted]) -> list[BlockErrors]:
        """Errors of fitted models on the recordings that were not trained on."""
        batch = self.batch(problem, [Slot(model=m.model, rows=1) for m in models], training=False)
        where = batch.dataset.validation
        every = torch.zeros_like(where)
        every[: batch.dataset.last_step(where)] = True
        errors = batch.simulate([m.physical[None] for m in models], every).cpu()
        count, weight = errors.shape[1], batch.dataset.weight
        weight = None if weight is None else weight[:count]
        cut = partial(block_errors, where=where[:count], control_dt=problem.control_dt, weight=weight, cfg=self.cfg)
        return [cut(error) for error in errors]

    def trained_errors(self, problem: TwinProblem, now: Fitted) -> torch.Tensor:
        """A model's errors on what is trained on, where fits take them, (K, R, n) [rad]."""
        batch = self.batch(problem, [Slot(model=now.model, rows=1)], training=True)
        return batch.simulate([now.physical[None]], batch.dataset.train, self.cfg.stride)[0].cpu()

    def on_joints(
        self, problem: TwinProblem, starts: Sequence[Fitted], joints: torch.Tensor, errors: BlockErrors
    ) -> tuple[list[Fitted], list[BlockErrors]]:
        """Fit models of all joints on some of them, and their errors; the others stay as they are, and cost nothing.

        Args:
            problem: All joints.
            starts: The models.
            joints: Which are fitted, (n,) bool.
            errors: What the other joints' errors are.
        """
        part = problem.on_joints(joints)
        fitted = self.coarse_to_fine(part, [start.on_joints(joints) for start in starts])
        after = [errors.with_joints(joints, own) for own in self.validation_errors(part, fitted)]
        return [start.with_joints(joints, own) for start, own in zip(starts, fitted, strict=True)], after

    def trimmed(self, problem: TwinProblem, now: Fitted, joints: torch.Tensor) -> Fitted | None:
        """A model fitted where it is not far worse than elsewhere; ``None`` where it is about as good in all windows.

        A joint that rattles in a gap or sticks and slips may, with a nearly right model, go on oscillating in one
        window where the robot does not. That window's error then outweighs all others and says nothing of where the
        truth lies. The windows that fit best do, and the others follow once the model is right (least trimmed squares,
        Rousseeuw 1984, least median of squares regression).

        Args:
            problem: The joints simulated alone.
            now: The model.
            joints: Which of them are fitted so, (n,) bool; for the others all windows count.
        """
        cfg = self.cfg
        result, best = None, torch.full_like(now.score, torch.inf)
        for _ in range(cfg.rounds):
            rmse = self.window_rmse(problem.in_windows(), now)
            median = rmse.median(dim=0).values
            kept = (rmse <= self.cfg.behind * median) | ~joints
            if bool(kept.all()) or not bool(((median < cfg.gain * best) & joints).any()):
                break
            best = median
            result = now = self.over_wide_steps(problem, now, kept)
        return result

    def window_rmse(self, windows: TwinProblem, now: Fitted) -> torch.Tensor:
        """A model's RMSE in each window on each joint, (R, n) [rad]."""
        batch = self.batch(windows, [Slot(model=now.model, rows=1)], training=True)
        where = batch.dataset.train
        error = batch.simulate([now.physical[None]], where)[0].cpu()
        return (error.double().square().sum(dim=0) / where.sum(dim=0).clamp(min=1)[:, None]).sqrt()

    def _fit(
        self,
        problem: TwinProblem,
        starts: Sequence[Fitted],
        max_iteration: int,
        keep_jacobian: bool,
        part: float,
        rough: bool,
        kept: torch.Tensor | None,
        chords: int,
    ) -> list[Fitted]:
        """:meth:`side_by_side` in one process."""
        cfg = self.cfg
        batch = self._batch_of(problem, starts)
        where = batch.dataset.train.clone()
        where[math.ceil(part * len(where)) :] = False
        counts = where[where.any(dim=1)][:: cfg.stride].sum(dim=0).double()
        weight = torch.ones(len(counts), starts[0].model.num_joints) if kept is None else kept.float()
        samples = counts @ weight.double()
        ways = running = [JointDescent(start, samples, keep_jacobian, rough, cfg) for start in starts]
        for _ in range(max_iteration):
            rows = [way.ask() for way in running]
            physical = [way.model.to_physical(x) for way, x in zip(running, rows, strict=True)]
            errors = batch.split(batch.simulate(physical, where, cfg.stride))
            for way, x, error in zip(running, rows, errors, strict=True):
                if not way.finished:  # where it ends must not depend on what is fitted beside it
                    way.tell(x, error if kept is None else error * weight.to(error.device))
            going = [way for way in running if not way.finished]
            if not going:
                break
            if len(going) < cfg.thinned * len(running):
                running, batch = going, self._batch_of(problem, going)
        if chords:
            batch = self.batch(problem, [Slot(model=way.model, rows=1) for way in ways], training=True)
        for _ in range(chords):
            if not any(way.leads for way in ways):
                break
            rows = [way.chord() for way in ways]
            physical = [way.model.to_physical(x) for way, x in zip(ways, rows, strict=True)]
            errors = batch.split(batch.simulate(physical, where, cfg.stride))
            for way, x, error in zip(ways, rows, errors, strict=True):
                way.tell_chord(x, error)
        return [way.result() for way in ways]

    def _batch_of(self, problem: TwinProblem, fits: Sequence[Fitted] | Sequence[JointDescent]) -> SideBySide:
        """What simulates one iteration of each."""
        slots = [Slot(model=each.model, rows=each.model.most_free + len(TRIALS)) for each in fits]
        return self.batch(problem, slots, training=True)

    def _near(self, models: Sequence[Fitted]) -> list[bool]:
        """Which models are near the best one on some joint."""
        scores = torch.stack([each.score for each in models])
        return (scores <= self.cfg.behind**2 * scores.amin(dim=0)).any(dim=1).tolist()


def _again(
    models: Sequence[Fitted], which: Sequence[bool], fit: Callable[[list[Fitted]], list[Fitted]]
) -> list[Fitted]:
    """All models, some of them fitted again."""
    if not any(which):
        return list(models)
    fitted = iter(fit([each for each, yes in zip(models, which, strict=True) if yes]))
    return [next(fitted) if yes else each for each, yes in zip(models, which, strict=True)]


def fits_on(device: str, cfg: FittingCfg) -> Fits:
    """What fits models on a device: ``"cpu"``, or a GPU as ``"cuda:0"``.

    On a processor with a compiler of C++ the same kernels run there; without one, the drives themselves do.

    Raises:
        ValueError: If there is no such device.
    """
    own = find_device(device)
    if own.type == "cpu":
        return Fits(cfg=cfg, batch=partial(SideBySide, compiler=host_kernels(), device=own))
    return Fits(cfg=cfg, batch=partial(SideBySide, compiler=kernels_of(own), device=own), on_gpu=True)
