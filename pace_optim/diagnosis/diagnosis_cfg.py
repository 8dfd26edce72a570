"""Every tuned number of a diagnosis, in one place; it is saved with what was found."""

from __future__ import annotations

from dataclasses import dataclass, field

from pace_optim.joints.fits.fitting_cfg import FittingCfg
from pace_optim.motion.design.telling_apart import MenuCfg


@dataclass(frozen=True, kw_only=True)
class CandidatesCfg:
    """Which effects are refitted, and from where."""

    folds: int = 5
    """Of the cross-validation of the score test, ..."""
    fold_s: float = 0.2
    """and the length of its blocks [s]."""
    explains: float = 0.03
    """An effect that would explain less than this part of what is left is not refitted."""
    valleys: int = 3
    """Frequencies of a comb that a refit begins at."""
    at_once: int = 64
    """Frequencies of a comb that are simulated side by side. Changes memory alone."""
    of_robot: int = 6
    """Effects refitted because they would explain most of the whole robot's error."""
    of_joint: int = 4
    """So many effects are refitted for each of so many worst joints."""
    from_screening: int = 2
    """How many of the best screened go on in any case, where refits began with all effects."""
    beyond_screening: float = 50.0
    """An error that is this many times the floor is beyond what screening can judge: refits begin with all effects."""
    seen: float = 0.3
    """With less than this part of an effect's amplitude left beside a base parameter, that one absorbs it."""
    seen_step: float = 0.1
    """Normalised step of that parameter: joints that stick make the error rough, and a narrow step sees that."""
    multiple: tuple[float, float] = (0.2, 20.0)
    """A refit starts at the best multiple of a probe, between these."""
    frictions: tuple[float, ...] = (-0.9, -0.5)
    """Normalised armature and friction that far starts begin with too, with a quarter of the delay."""


@dataclass(frozen=True, kw_only=True)
class JudgingCfg:
    """When one model of a joint is better than another, and when they are alike; ratios are of validation RMSE."""

    level: float = 0.02
    """Chance of a false alarm over all that was tried; of a fall that is ``clear`` that of one trial."""
    alike: float = 1.10
    """Models up to this ratio apart are alike: the first effect must bring more, and effects within it are
    reported together. Of these, the simplest is taken: with the fewest parameters, or with one value for all joints.
    An error within it of the floor is at the floor."""
    next_effect: float = 1.25
    """What each further effect must bring: nearer to the floor than this none could."""
    clear: float = 1.5
    """A fall that is this large need not stand out of all that was tried. Something is missing on a joint that ends
    this many times above its floor."""
    far: float = 3.0
    """A joint is far from the floor above this many times it: more is missing. An effect comes near to another one up
    to this ratio apart. A joint is held at the robot's delay where a separate delay leaves an error this many times
    lower."""
    in_place: int = 3
    """So many of those that came near are tried in place of a joint's effects."""


@dataclass(frozen=True, kw_only=True)
class VerdictCfg:
    """Whether a name is earned (``selection/naming.py``), and what a curve must show."""

    most: float = 0.75
    """Wrong links together, and a curve, must explain this part of the squared error above the floor without them, so
    that they halve the error. A curve takes the place of effects where it does so to what they leave. An effect
    dominates above this share."""
    scatter: float = 0.17
    """A name needs sizes in single recordings that differ by no more than this part of the size (RMS). Measured: up to
    0.164 for true effects beside others as large together, but for two of 0.22 and 0.28; 0.18 to 0.79 for proxies."""
    reached: float = 0.998
    """Quantile of a variable up to which the knots of a curve reach."""


RULES = (
    "look_ahead",
    "replace",
    "pool",
    "trim",
    "wide_steps",
    "second_try",
    "widen_bounds",
    "multistart",
    "late_joints",
    "curves",
)
"""Moves and rules of a diagnosis that can be switched off."""


@dataclass(frozen=True, kw_only=True)
class LinksCfg:
    """Numbers of the search for wrong links, beside those of :class:`JudgingCfg` and :class:`VerdictCfg`."""

    explains: float = 0.3
    """A link is fitted if it would explain this part of the squared error above the noise, to first order, and is kept
    if it does: each of three wrong links may. So much must an iteration of a look-alike, far above what links leave."""
    same: float = 1.01
    """Errors up to this ratio apart are the same: of as many parameters, those of the outermost link are taken."""
    share: float = 0.25
    """Share of each recording that candidates are screened and compared on."""
    places: int = 13
    """Places to a side at which a load on a link is tried first."""
    load_starts: int = 8
    """The best of them that are refined, ..."""
    load_place: float = 1e-4
    """... until their neighbours are this near [m]."""
    tried: int = 6
    """Candidates of a round that are fitted, ..."""
    of_link: int = 3
    """and so many of them of one link."""
    iterations: int = 15
    """Of each fit, at most."""
    most: int = 3
    """Wrong links, at most."""
    tolerance: float = 1e-3
    """They end where less than this part of the score is left to gain."""
    cost: float = 0.25
    """Power of the number of parameters by which what they explain is divided."""


@dataclass(frozen=True, kw_only=True)
class DiagnosisCfg:
    """A diagnosis' numbers, and which of its moves are made."""

    fitting: FittingCfg = field(default_factory=FittingCfg)
    candidates: CandidatesCfg = field(default_factory=CandidatesCfg)
    judging: JudgingCfg = field(default_factory=JudgingCfg)
    verdict: VerdictCfg = field(default_factory=VerdictCfg)
    menu: MenuCfg = field(default_factory=MenuCfg)
    links: LinksCfg = field(default_factory=LinksCfg)
    off: tuple[str, ...] = ()
    """Which of ``RULES`` are not made, for an ablation."""

    def __post_init__(self) -> None:
        """Check the names.

        Raises:
            ValueError: If a rule is unknown.
        """
        if unknown := [name for name in self.off if name not in RULES]:
            raise ValueError(f"There is no rule {unknown[0]!r} to switch off. Available: {', '.join(RULES)}.")

    def has(self, rule: str) -> bool:
        """Whether a rule is in force."""
        return rule not in self.off


DEFAULT = DiagnosisCfg()
"""As it is shipped."""
