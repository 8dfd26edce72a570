"""How models of single joints are simulated and fitted: several side by side, in windows and on whole recordings."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import torch

from pace_actuators.effects import Effect
from pace_envs.compiler import host_kernels, kernels_of
from pace_envs.devices import find_device
from pace_optim.estimate.levenberg_marquardt import (
    DAMPING_TRIALS,
    FIRST_DAMPING,
    LinearModel,
    next_damping,
)
from pace_optim.joints.fits.block_errors import BlockErrors, block_errors
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.fits.fitting_cfg import FittingCfg
from pace_optim.joints.fits.side_by_side import SideBySide, Slot
from pace_optim.joints.simulation.problem import TwinProblem
from pace_optim.terminal.parallel import parallel_map

TRIALS = DAMPING_TRIALS[:-1]
"""Those of a whole robot's fit without the largest: a joint has few parameters."""


class JointDescent:
    """One model's descent: rows are the favoured step, its neighbours for the next Jacobian, and the other trials.

    Where the favoured step wins, the next derivatives are already known. In a neighbour every joint has another one of
    its free entries moved, so that there are as many as a joint has, and not as many as all joints have together.
    """

    def __init__(self, start: Fitted, samples: torch.Tensor, keep: bool, rough: bool, cfg: FittingCfg):
        """Begin at the model's x.

        Args:
            samples: How many count for each joint, (n,).
            keep: Whether the last Jacobian is kept.
            rough: Whether derivatives are taken over wide steps first.
        """
        self._cfg = cfg
        self.model, self.tried, self._samples, self._keep = start.model, start.tried, samples, keep
        self._lengths = start.steps
        n = len(start.x)
        self.x = start.x.clone()
        self.score = torch.full((n,), torch.inf, dtype=torch.float64)
        self._damping = torch.full((n,), FIRST_DAMPING, dtype=torch.float64)
        self._free = [own.nonzero()[:, 0] for own in start.model.free]
        most = start.model.most_free
        self._hessian = torch.zeros(n, most, most, dtype=torch.float64)
        self._gradient = torch.zeros(n, most, dtype=torch.float64)
        self._known = torch.zeros(n, dtype=torch.bool)
        self._still = torch.zeros(n, dtype=torch.long)
        self._converged = torch.zeros(n, dtype=torch.bool)
        self._widths = torch.tensor([*(cfg.wide if rough else ()), cfg.narrow], dtype=torch.float64)
        self._width = torch.zeros(n, dtype=torch.long)
        self._jacobian: torch.Tensor | None = None
        self._error: torch.Tensor | None = None
        self._led = torch.ones(n, dtype=torch.bool)
        self._scores: list[float] = []

    @property
    def finished(self) -> bool:
        """Whether every joint has once come to its end."""
        return bool(self._converged.all())

    def ask(self) -> torch.Tensor:
        """Normalised rows, (neighbours + trials, n, P)."""
        trials = self.x.repeat(len(TRIALS), 1, 1)
        for j in self._known.nonzero()[:, 0].tolist():
            at, linear = self._linear_model(j)
            trials[:, j, at] = linear.trials(self.x[j, at], float(self._damping[j]), TRIALS)
        favoured = trials[0]
        width = self._widths[self._width][:, None] if self._lengths is None else self._lengths
        self._step = torch.where(favoured > 0, -width, width)
        neighbours = favoured.repeat(self._gradient.shape[1], 1, 1)
        for j, at in enumerate(self._free):
            neighbours[torch.arange(len(at)), j, at] += self._step[j, at]
        return torch.cat([trials[:1], neighbours, trials[1:]])

    def tell(self, x: torch.Tensor, error: torch.Tensor) -> None:
        """Take the best row of each joint."""
        size = self.x.shape[1]
        scores = error.square().sum(dim=(1, 2), dtype=torch.float64).cpu() / self._samples
        choice = [0, *range(len(x) - len(TRIALS) + 1, len(x))]  # the trials, the favoured first
        best = scores[choice].argmin(dim=0)
        lowest = scores[choice].gather(0, best[None])[0]
        better = lowest < self.score
        # a joint whose Jacobian was not known has not moved: its favoured row is x itself, and shows no gain
        fresh = ~self._known
        gain = (self.score - lowest) / self.score
        self._still = torch.where(fresh, self._still, torch.where(gain > self._cfg.enough, 0, self._still + 1))
        narrower = (self._still > 0) & (self._width + 1 < len(self._widths))
        self._still[narrower] = 0
        self._converged |= self._still >= 2
        chosen = x[choice].gather(0, best[None, :, None].expand(1, -1, size))[0]
        moved = better & ~fresh
        self.x = torch.where(moved[:, None], chosen, self.x)
        self.score = torch.where(better, lowest, self.score)
        self._scores.append(float(self.score.sum()))
        for j in (~fresh).nonzero()[:, 0].tolist():
            self._damping[j] = next_damping(float(self._damping[j]), int(best[j]) if bool(moved[j]) else None)
        at_favoured = fresh | (moved & (best == 0))
        self._known = torch.where(at_favoured, True, torch.where(moved, False, self._known)) & ~narrower
        self._width += narrower
        self._damping = torch.where(narrower, FIRST_DAMPING, self._damping)
        if bool(at_favoured.any()):
            columns = error[1 : 1 + self._gradient.shape[1]] - error[:1]
            columns /= self._steps()[:, None, None, :].to(error.device, torch.float32)
            hessian = torch.einsum("pkrj,skrj->jps", columns, columns).cpu().double() / self._samples[:, None, None]
            gradient = torch.einsum("pkrj,krj->jp", columns, error[0]).cpu().double() / self._samples[:, None]
            self._hessian = torch.where(at_favoured[:, None, None], hessian, self._hessian)
            self._gradient = torch.where(at_favoured[:, None], gradient, self._gradient)
            self._converged |= at_favoured & ~narrower & self._at_the_bottom()
            if self._keep:
                self._keep_derivatives(columns, error[0], at_favoured)
        if self._error is not None:
            for j in moved.nonzero()[:, 0].tolist():
                self._error[..., j] = error[choice[int(best[j])], ..., j]

    @property
    def leads(self) -> bool:
        """Whether the last chord step has led a joint further."""
        return bool(self._led.any())

    def chord(self) -> torch.Tensor:
        """Where the derivatives that were kept lead from x, (1, n, P); joints that they led no further stay."""
        if self._jacobian is None or self._error is None:
            raise ValueError("Chord steps need a descent that keeps its Jacobian.")
        result = self.x.clone()
        for j in self._led.nonzero()[:, 0].tolist():
            at = self._free[j]
            columns = self._jacobian[at.to(self._jacobian.device), ..., j].flatten(1)
            gradient = (columns @ self._error[..., j].flatten()).cpu().double() / self._samples[j]
            linear = LinearModel(self._hessian[j, : len(at), : len(at)], gradient)
            result[j, at] = linear.step(self.x[j, at], 0.0)
        return result[None]

    def tell_chord(self, x: torch.Tensor, error: torch.Tensor) -> None:
        """Take the row (1, n, P) on joints where its error (1, K, R, n) is lower."""
        score = error[0].square().sum(dim=(0, 1), dtype=torch.float64).cpu() / self._samples
        self._led &= score < self.score
        self.x = torch.where(self._led[:, None], x[0], self.x)
        self.score = torch.where(self._led, score, self.score)
        if self._error is not None:
            self._error = torch.where(self._led.to(error.device), error[0], self._error)

    def _steps(self) -> torch.Tensor:
        """By how much each joint is moved in each neighbour, (neighbours, n); 1 where it is not."""
        result = torch.ones(self._gradient.T.shape, dtype=torch.float64)
        for j, at in enumerate(self._free):
            result[: len(at), j] = self._step[j, at]
        return result

    def _keep_derivatives(self, columns: torch.Tensor, error: torch.Tensor, joints: torch.Tensor) -> None:
        """Keep the errors of some joints, (n,) bool, and their derivatives by the entries that are free."""
        if self._jacobian is None or self._error is None:
            self._jacobian = torch.zeros(self.x.shape[1], *error.shape, dtype=error.dtype, device=error.device)
            self._error = torch.zeros_like(error)
        for j in joints.nonzero()[:, 0].tolist():
            at = self._free[j]
            self._jacobian[at.to(error.device), ..., j] = columns[: len(at), ..., j]
            self._error[..., j] = error[..., j]

    def _at_the_bottom(self) -> torch.Tensor:
        """Joints whose linear model, of the narrowest derivatives, promises next to nothing, (n,) bool."""
        result = self._width + 1 == len(self._widths)
        for j in result.nonzero()[:, 0].tolist():
            at, linear = self._linear_model(j)
            x = self.x[j, at]
            promised = linear.expected_gain(linear.step(x, FIRST_DAMPING) - x)
            result[j] = promised < self._cfg.enough / 10 * float(self.score[j])
        return result

    def _linear_model(self, joint: int) -> tuple[torch.Tensor, LinearModel]:
        """Free entries of a joint, and the linear model of its score by them."""
        at = self._free[joint]
        own = slice(len(at))
        return at, LinearModel(self._hessian[joint, own, own], self._gradient[joint, own])

    def result(self) -> Fitted:
        """Where it ended."""
        return Fitted(
            model=self.model,
            x=self.x,
            score=self.score,
            tried=self.tried,
            jacobian=None if self._jacobian is None else self._jacobian.cpu(),
            error=None if self._error is None else self._error.cpu(),
            falls=self._falls(),
        )

    def _falls(self) -> bool:
        """Whether the last steps have lowered the error."""
        last = self._scores[-1 - self._cfg.rounds :]
        return not self.finished and len(last) > 1 and last[-1] < (1 - self._cfg.falls) * last[0]


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

    def looked_closely(self, problem: TwinProblem, now: Fitted) -> Fitted:
        """A model where it is, with derivatives over steps that change each joint by as much as its error is.

        A parameter that hardly moves a joint needs long steps: over short ones, friction that sticks moves it more.
        """
        if now.jacobian is None or now.error is None:
            now = self.looked_at(problem, [now])[0]
        assert now.jacobian is not None and now.error is not None
        each = (now.jacobian, now.error)
        moves, error = (own.double().movedim(-1, 0).flatten(-2).square().mean(dim=-1).sqrt() for own in each)
        steps = (error[:, None] / moves.clamp(min=1e-12)).clamp(self.cfg.narrow, self.cfg.wide[0])
        start = replace(Fitted.start(now.model, now.physical, tried=now.tried), steps=steps)
        return self.side_by_side(problem, [start], 1, keep_jacobian=True)[0]

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
            if len(going) <= len(running) / 2:  # changes time alone
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
