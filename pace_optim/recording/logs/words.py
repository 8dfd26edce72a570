"""What a column's name says: which series, which joint, which unit."""

from __future__ import annotations

import itertools
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

POSITION, VELOCITY, EFFORT = "dof_pos", "dof_vel", "dof_effort"
TEMPERATURE, VOLTAGE = "temperature", "voltage"

UNITS: dict[str, dict[str, float]] = {
    POSITION: {
        "rad": 1.0, "deg": np.pi / 180, "mrad": 1e-3, "mdeg": np.pi / 180e3, "cdeg": np.pi / 18e3,
        "turn": 2 * np.pi, "m": 1.0, "cm": 1e-2, "mm": 1e-3,
    },
    VELOCITY: {
        "rad/s": 1.0, "deg/s": np.pi / 180, "rpm": np.pi / 30, "turn/s": 2 * np.pi, "mrad/s": 1e-3,
        "mdeg/s": np.pi / 180e3, "cdeg/s": np.pi / 18e3, "m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3,
    },
    EFFORT: {
        "N m": 1.0, "mN m": 1e-3, "N cm": 1e-2, "N mm": 1e-3, "kN m": 1e3, "kgf cm": 9.80665e-2, "N": 1.0, "kN": 1e3,
        "A": 1.0, "mA": 1e-3, "%": 1e-2, "permille": 1e-3,
    },
    TEMPERATURE: {"°C": 1.0, "0.1 °C": 0.1},
    VOLTAGE: {"V": 1.0, "0.1 V": 0.1, "mV": 1e-3},
}  # fmt: skip
"""Units of each quantity, in SI units; those of ``NEED_FACTOR`` want a factor too."""
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
TIME_WORDS = {
    word: unit
    for unit, spelt in (
        ("s", "s sec secs second seconds"),
        ("ms", "ms msec msecs millis millisec millisecs milliseconds"),
        ("us", "us usec usecs micros microsec microsecs microseconds"),
        ("ns", "ns nsec nsecs nanosec nanosecs nanos nanoseconds"),
    )
    for word in spelt.split()
}
"""What units of time are called."""
CURRENTS = ("A", "mA")
NEED_FACTOR = {"A": "A", "mA": "A", "%": "100 %", "permille": "1000 permille"}
"""Units of efforts that are no torques, and what their factor [N m] is for one of."""
GAINS = {"kp": "stiffness", "stiffness": "stiffness", "kd": "damping", "damping": "damping"}
"""Columns of gains: the word, and the fact that it is."""

_TIMES = {
    "t", "time", "times", "timestamp", "timestamps", "stamp", "stamps", "ts", "clock", "datetime", "date", "elapsed",
    "zeit", *(word for word in TIME_WORDS if word not in TIME_UNITS),
}  # fmt: skip
_OF_TIMES = {
    "header", "ros", "log", "unix", "epoch", "since", "start", "utc", "from", "relative", "rel", "sim", "wall",
    "system", "sys", "boot", "monotonic", "host", "received", "recv", "rx", "local", "sample", "abs",
    "real",
}  # fmt: skip
"""Words beside those."""
_COMMAND = {
    "cmd", "cmds", "command", "commands", "commanded", "des", "desired", "target", "targets", "goal", "ref",
    "reference", "setpoint", "set", "action", "actions", "sp", "ctrl", "input", "lowcmd", "soll",
}  # fmt: skip
_MEASURED = {
    "meas", "measured", "actual", "act", "present", "current", "feedback", "fb", "obs", "observation", "state",
    "states", "est", "real", "read", "encoder", "enc", "lowstate", "sensor", "filtered", "ist",
}  # fmt: skip
_NO_QUANTITY = {
    "state", "states", "action", "actions", "cmd", "command", "commands", "commanded", "des", "desired", "target",
    "goal", "ref", "reference", "setpoint", "sp", "set", "actual", "act", "measured", "meas", "present", "feedback",
    "fb", "encoder", "enc", "ist", "soll",
}  # fmt: skip
"""Words for positions in names without a quantity."""
_POSITION = {"pos", "position", "positions", "q", "angle", "angles", "qpos", "theta", "phi", "angular", "winkel"}
_VELOCITY = {"vel", "velocity", "velocities", "dq", "qd", "qvel", "speed", "speeds", "omega", "qdot", "rate"}
_EFFORT = {
    "effort", "efforts", "torque", "torques", "tau", "trq", "tq", "moment", "ff", "feedforward", "load", "force",
    "forces",
}  # fmt: skip
_AMPERES = {"amp", "amps", "ampere", "amperes", "iq", "currents", "curr"}
_OTHER = {
    "error", "err", "errors", "ki", "gain", "gains", "duty",
    "accel", "acc", "acceleration", "accelerations", "ddq", "qdd", "imu", "quat", "quaternion", "gyro", "index",
    "frame", "episode", "task", "limit", "min", "max", "status", "fault", "mode", "std", "pwm", "power", "id",
    "reserve", "seq", "reward", "done", "success", "foot", "tick", "crc", "checksum", "last", "prev", "previous",
    "column", "tcp", "pose", "orientation",
}  # fmt: skip
_DERIVED = {"error", "err", "errors", "limit", "min", "max", "std", "last", "prev", "previous"}
"""Those of them that make another series of a joint's: ``hip_last_pos``."""
_CONDITIONS = {
    **dict.fromkeys(("temp", "temps", "temperature", "temperatures"), TEMPERATURE),
    **dict.fromkeys(("voltage", "voltages", "volt", "volts", "vbus"), VOLTAGE),
}
_NOT_OF_DRIVES = {"ambient", "room", "air", "cpu", "gpu", "board", "mcu", "ntc", "cell", "cells"}
"""Words of temperatures and voltages of other things than drives."""
_GENERIC = {"joint", "joints", "j", "motor", "motors", "dof", "actuator", "servo", "axis", "drive", "link", "data"}
_SIDES = {"l": "left", "r": "right"}
PER_S = r"(?:[ _]?(?:/|per)[ _]?s(?:ec(?:onds?)?)?|[ _.·⋅*]?s(?:\^-1|⁻¹))"
_TURNS = "(revs?|revolutions?|turns?)"
_BEGIN = "(?:(?<![a-z])|(?-i:(?<=[a-z])(?=[A-Z])))"
"""Where a word begins, in upper case within a name without separators."""
_DOT = r"[ _.·⋅*-]?"
_UNIT_PATTERNS: tuple[tuple[str, str, str], ...] = (
    (r"°c\b|\bdeg(rees?)?[ _]?c(elsius)?\b|\bcelsius\b|[\[(]c[\])]", TEMPERATURE, "°C"),
    (r"\bmv\b|millivolts?", VOLTAGE, "mV"),
    (r"[\[(]v[\])]", VOLTAGE, "V"),
    (rf"{_BEGIN}mdeg({PER_S}|_s\b)", VELOCITY, "mdeg/s"),
    (rf"{_BEGIN}cdeg({PER_S}|_s\b)", VELOCITY, "cdeg/s"),
    (rf"{_BEGIN}mrad({PER_S}|_s\b)", VELOCITY, "mrad/s"),
    (rf"(?<!{_BEGIN}[mcd])deg((rees?)?{PER_S}|_s\b)|dps\b|(?<!m)°{PER_S}", VELOCITY, "deg/s"),
    (rf"(?<!{_BEGIN}[mcg])rad((ians?)?{PER_S}|_s\b)|[\[(](1/s(ec)?|s\^-1|s⁻¹)[\])]", VELOCITY, "rad/s"),
    (rf"\brpm\b|{_TURNS}[ _]?(/|per)[ _]?min(utes?)?\b", VELOCITY, "rpm"),
    (rf"{_TURNS}{PER_S}|rps\b", VELOCITY, "turn/s"),
    (rf"\bmm{PER_S}\b|mm_s\b", VELOCITY, "mm/s"),
    (rf"\bcm{PER_S}\b|cm_s\b", VELOCITY, "cm/s"),
    (rf"\bm{PER_S}\b|[\[( _]m_s\b", VELOCITY, "m/s"),
    (r"‰|\bper[ _]?mille?\b", EFFORT, "permille"),
    (r"%|\bpercent\b|\bpct\b", EFFORT, "%"),
    (rf"\bmn{_DOT}m\b", EFFORT, "mN m"),
    (rf"\bn{_DOT}cm\b", EFFORT, "N cm"),
    (rf"\bn{_DOT}mm\b", EFFORT, "N mm"),
    (rf"\bkn{_DOT}m\b", EFFORT, "kN m"),
    (rf"\bkgf?{_DOT}cm\b", EFFORT, "kgf cm"),
    (rf"\bn{_DOT}m\b", EFFORT, "N m"),
    (r"[\[(]kn[\])]", EFFORT, "kN"),
    (r"[\[(]n[\])]", EFFORT, "N"),
    (r"\bma\b|milliamps?", EFFORT, "mA"),
    (r"\bamps?\b|\bamperes?\b|[\[( ]a[\]) ]|[ _]a$", EFFORT, "A"),
    (r"\bmrad\b", POSITION, "mrad"),
    (r"\bmdeg\b", POSITION, "mdeg"),
    (r"\bcdeg\b", POSITION, "cdeg"),
    (r"\bdeg(rees?)?\b|°", POSITION, "deg"),
    (r"\brad(ians?)?\b", POSITION, "rad"),
    (r"\b(turns?|revs?|revolutions?)\b", POSITION, "turn"),
    (r"\bmm\b", POSITION, "mm"),
    (r"\bcm\b", POSITION, "cm"),
    (r"[\[( ]m[\]) ]|[ _]m$", POSITION, "m"),
)
_UNIT_WORDS = {
    "deg", "degree", "degrees", "rad", "radian", "radians", "rpm", "nm", "mnm", "ms", "us", "ns", "ma", "turn",
    "turns", "rev", "dps", "per", "sec", "mrad", "rps", "mm", "cm", "percent", "pct", "mille", "permille",
    "mdeg", "cdeg", "ncm", "nmm", "knm", "kn", "kgcm", "kgfcm",
}  # fmt: skip
"""Not the letters n, m, s and a, which name joints (A1): they are units only where a pattern above says so."""


_BRACKET = re.compile(r"[\[(]\s*([^\[(\])]*?)\s*[\])]\s*$")
_SYMBOL = (
    r"(?:1/s(?:ec)?|1/min|(?:da|[mµuk])?n(?:mm|cm|dm|m)?|(?:kgf?|gf?)(?:mm|cm|m)|oz(?:in)?|in(?:lbf?)?|inch(?:es)?|"
    r"lbf?(?:in|ft)?|f(?:oo)?t(?:lbf?)?|"
    r"[mcdµuk]?m|[mcdµu]?rad|[mcdµu]?deg|[mcdµu]?°|[mcdµu]?degrees?|g(?:rad|on)|turns?|rev(?:s|olutions?)?|"
    r"ticks?|counts?|cnts?|inc(?:rements?)?|lsb|steps?|pulses?|bits?|raw|digits?|[mk]?a|[mk]?v|[mk]?hz|rpm|dps|rps|"
    r"°c|°f|deg ?[cf]|[cfk]|%|‰|[mµun]?s|sec|min|h|[mk]?g|kgf|gf|ozf?|[mk]?w|[mk]?j)"
)
_LIKE_A_UNIT = re.compile(
    rf"(?:\d+(?:\.\d+)?(?:e-?\d+)? ?)?{_SYMBOL}(?:[ _.·⋅*/-]{{1,2}}{_SYMBOL}|\^-?[123]|⁻?[¹²³]|(?<=/s)2)*"
)
"""What stands in brackets behind a name and is a unit, known or not: no joint's name or number."""

_SI_GAIN = re.compile(r"nm?s?(?:/(?:rad|m)(?:/s)?|(?:rad|m)(?:\^-1|⁻¹))?")
"""A gain's unit that is as facts have it, without what stands between its symbols."""

_SEAMS = re.compile(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])|(?<=[A-Za-z])(?=\d)|(?<=\d)(?=[A-Za-z])")
"""Where a word ends inside of a name without separators."""
_SERIES = (
    _COMMAND | _MEASURED | _POSITION | _VELOCITY | _EFFORT | _AMPERES | _UNIT_WORDS | set(GAINS) | set(_CONDITIONS)
)
"""Words of a series: they are of no joint's name, unless they stand inside of one (:func:`joint_places`)."""


@dataclass(frozen=True, kw_only=True)
class Meaning:
    """What a name says; "" and () where it says nothing."""

    quantity: str
    """`dof_pos`, `dof_vel`, `dof_effort`, `temperature`, `voltage`, `torque_enable`, `stiffness`, `damping` or ""."""
    commanded: bool
    unit: str
    joint: tuple[str, ...]
    """Words of the joint's name."""
    unknown_unit: str = ""
    """A unit that the name states and that is not known."""


def words(name: str) -> list[str]:
    """The words of a name in lower case: ``leftHip_J2`` has left, hip, j, 2."""
    return [word for word, _, _ in _placed(name)]


def _placed(name: str) -> list[tuple[str, int, int]]:
    """The words of a name, and where each begins and ends in it."""
    found = []
    for chunk in re.finditer(r"[A-Za-z0-9°]+", name):
        at = chunk.start()
        for part in _SEAMS.split(chunk[0]):
            found.append((_SIDES.get(part.lower(), part.lower()), at, at + len(part)))
            at += len(part)
    return found


def joint_words(name: str) -> tuple[str, ...]:
    """The words that identify a joint: of ``q1`` and ``joint_1`` the number."""
    found = tuple(word for word in words(name) if word not in _GENERIC)
    numbers = tuple(word for word in found if word not in _POSITION)
    if numbers and all(word.isdigit() for word in numbers):
        return numbers
    return found or tuple(words(name))


def meaning(name: str, table: str = "", joint: tuple[int, int] | None = None) -> Meaning:
    """What a column's name says.

    Args:
        table: What names the topic or file, in which a command may be named.
        joint: Where the joint's name stands in it (:func:`joint_places`): its words say nothing else.
    """
    whole = name
    if joint is not None:
        name = f"{whole[: joint[0]]} {whole[joint[1] :]}"
    unknown = _unknown_unit(name)
    unit, of_unit, without_unit = ("", "", _BRACKET.sub("", name)) if unknown else _unit(name)
    name = without_unit if unknown or unit == "rpm" else name  # which may be rev/min
    own, around = words(name), words(table)
    said = set(own)
    current = (
        bool(said & _AMPERES)
        or unit in CURRENTS
        or ("current" in said and not said & _POSITION and not said & _VELOCITY)
        or bool(set(around) & _AMPERES and not said & (_POSITION | _VELOCITY | _EFFORT))
    )
    spoken = _SERIES | set(around)
    if joint is not None and not own:  # a joint's name alone
        quantity = POSITION if set(words(whole)) & _POSITION else _of_table(set(), set(around))
    elif said & _OTHER:
        quantity = ""
    elif said & set(_CONDITIONS):
        quantity = _condition(own, set(around))
    elif said & {"enabled", "enable"} or ("on" in said and said & {"torque", "servo", "motor", "drive", "power"}):
        quantity = "torque_enable"
    elif gain := [GAINS[word] for word in own if word in GAINS]:
        quantity = gain[0]
    elif current or said & _EFFORT:
        quantity = EFFORT
    elif said & _VELOCITY:
        quantity = VELOCITY
    elif said & _POSITION:
        quantity = POSITION
    else:
        quantity = of_unit or _of_table(said, set(around))
    commanded = bool((said | set(around)) & _COMMAND) and not (said & _MEASURED - {"current"} and not said & _COMMAND)
    commanded = commanded and quantity not in (TEMPERATURE, VOLTAGE)
    if quantity == EFFORT and said & {"ff", "feedforward"}:
        commanded = True
    if of_unit == EFFORT and unit in ("%", "permille") and quantity != EFFORT:
        quantity = ""  # part of a range that nothing states
    if quantity in GAINS.values():
        unknown = _unknown_gain(whole)
    elif quantity not in UNITS:
        unknown = ""
    if quantity == "torque_enable":
        spoken = spoken | {"enable", "enabled", "on"}
    label = [word for word in words(without_unit) if word not in spoken]
    if joint is not None:
        before, after = (words(text) for text in (whole[: joint[0]], whole[joint[1] :]))
        of_joint = whole[slice(*joint)]
        as_one = of_joint if re.fullmatch(r"[\w.-]+", of_joint) else "_".join(words(of_joint))
        kept = [[word for word in part if word not in spoken and word in label] for part in (before, after)]
        label = [*kept[0], as_one, *kept[1]]
    if not unit and current and quantity == EFFORT:
        unit = "A"
    if not unit and quantity == EFFORT and said & _EFFORT == {"load"}:
        unit, of_unit = "%", EFFORT  # a servo's register, of a duty or of its largest torque
    unit = unit if of_unit in ("", quantity) else ""
    return Meaning(quantity=quantity, commanded=commanded, unit=unit, joint=tuple(label), unknown_unit=unknown)


def joint_places(columns: Iterable[str], joint_names: Sequence[str] = ()) -> dict[str, tuple[int, int]]:
    """Where a joint's name stands in those of columns, such as ``index_q1`` in ``index_q1_pos``.

    1. A name that the robot has; of several the longest, and outside of brackets with a unit before inside.
    2. What a column of positions shares with one of commands: ``JOINT_pos`` and ``JOINT_cmd``. Of several the longest
       that leaves a word for the series. Brackets with a unit are no part of it, unless they hold joints
       (:func:`_joints_like_units`).
    3. What other columns have where those two kinds have their joints: ``JOINT_vel``, and ``JOINT_pos`` alone.
    """
    columns = list(columns)
    of_robot = sorted((tuple(words(name)) for name in joint_names), key=len, reverse=True)
    in_brackets = _joints_like_units(columns)
    found: dict[str, tuple[int, int]] = {}
    splits: dict[str, list[_Split]] = {}
    nameless = False
    for column in columns:
        bracket = _unit_in_bracket(column)
        placed = _placed(column[: bracket.start()] if bracket else column)
        own = tuple(word for word, _, _ in placed)
        if at := next((at for name in of_robot if (at := _where(own, name))), None):
            found[column] = placed[at.start][1], placed[at.stop - 1][2]
        elif bracket and (tuple(words(bracket[1])) in of_robot or column in in_brackets):
            found[column] = bracket.span(1)
        else:
            nameless |= set(own) <= _SERIES
            splits[column] = _splits(placed)
    every = [(column, split) for column, those in splits.items() for split in those]
    commanded = {split.joint for _, split in every if split.is_command}
    pairs = commanded & {split.joint for _, split in every if split.is_position} | ({()} if nameless else set())
    around = {split.around for _, split in every if split.joint in pairs and (split.is_command or split.is_position)}
    for column, those in splits.items():
        of_pair = [split for split in those if split.joint in pairs and not _derived(split.joint, pairs)]
        like_pair = [split for split in those if split.around in around and not set(split.joint) & _OTHER]
        if best := max(of_pair or like_pair, key=lambda split: len(split.joint), default=None):
            found[column] = best.place
    return found


@dataclass(frozen=True, kw_only=True)
class _Split:
    """One way to read a column's name: a joint, and words of a series around it."""

    joint: tuple[str, ...]
    around: tuple[tuple[str, ...], tuple[str, ...]]
    """The words before it and after it."""
    place: tuple[int, int]

    @property
    def is_command(self) -> bool:
        return bool({word for part in self.around for word in part} & _COMMAND)

    @property
    def is_position(self) -> bool:
        """Whether it is of measured positions; with no word for them, neither end of the joint's name may be one."""
        said = {word for part in self.around for word in part}
        if said & (_COMMAND | _VELOCITY | _EFFORT | _AMPERES | set(GAINS) | set(_CONDITIONS)):
            return False
        ends = {self.joint[0], self.joint[-1]}
        return bool(said & _POSITION) or (
            bool(said & _MEASURED - {"current"})
            and not ends & (_POSITION | _VELOCITY | _EFFORT | _AMPERES | {"current"})
        )


def _splits(placed: Sequence[tuple[str, int, int]]) -> list[_Split]:
    """All ways to take words of a series off a name's ends."""
    own = tuple(word for word, _, _ in placed)
    before = len(list(itertools.takewhile(_SERIES.__contains__, own)))
    after = len(list(itertools.takewhile(_SERIES.__contains__, reversed(own))))
    return [
        _Split(joint=own[i:j], around=(own[:i], own[j:]), place=(placed[i][1], placed[j - 1][2]))
        for i in range(before + 1)
        for j in range(len(own) - after, len(own) + 1)
        if j - i < len(own) and not set(own[i:j]) <= _SERIES and own[j - 1] not in _UNIT_WORDS
    ]


def _derived(joint: tuple[str, ...], pairs: Collection[tuple[str, ...]]) -> bool:
    """Whether a name is that of another joint with a word such as ``last`` or ``error``."""
    plain = tuple(word for word in joint if word not in _DERIVED)
    return plain != joint and plain in pairs


def _where(own: tuple[str, ...], name: tuple[str, ...]) -> slice | None:
    """Where a name's words stand in those of a column, one after another."""
    places = (slice(i, i + len(name)) for i in range(len(own) - len(name) + 1))
    return next((place for place in places if name and own[place] == name), None)


def _condition(own: Sequence[str], around: set[str]) -> str:
    """What a temperature or a voltage is: of no drive, and of one that is commanded, nothing is read."""
    said, quantity = set(own), next(_CONDITIONS[word] for word in own if word in _CONDITIONS)
    commanded = said & (_COMMAND - {"input"}) and not said & _MEASURED  # "present input voltage" is the supply's
    of_battery = quantity == TEMPERATURE and (said | around) & {"battery", "imu"}
    return "" if commanded or of_battery or said & _NOT_OF_DRIVES else quantity


def is_time(name: str) -> bool:
    """Whether a column is called as time is."""
    own = set(words(name))
    return bool(own & _TIMES) and not own - _TIMES - _OF_TIMES - _UNIT_WORDS - {"s"}


def time_unit(name: str) -> str:
    """The unit that a column of time states, or ""."""
    found = [unit for word in words(name) if (unit := TIME_WORDS.get(word))]
    return found[-1] if found else ""


def _of_table(said: set[str], around: set[str]) -> str:
    every = said | around
    for quantity, names in ((EFFORT, _EFFORT), (VELOCITY, _VELOCITY), (POSITION, _POSITION)):
        if every & names:
            return quantity
    return POSITION if every & _NO_QUANTITY else ""


def _unit_in_bracket(name: str) -> re.Match[str] | None:
    """The bracket at the end of a name, where it holds a unit, known or not."""
    bracket = _BRACKET.search(name)
    if bracket is None or not _LIKE_A_UNIT.fullmatch(bracket[1].lower()):
        return None
    if len(bracket[1]) == 1 and not set(words(name)) & set(_CONDITIONS):
        return None  # a letter may name a joint
    return bracket


def _is_known(unit: str) -> bool:
    """Whether a pattern is all of a unit."""
    text = f"[{unit.lower()}]"
    return any(re.search(rf"^\[?(?:{pattern})\]?$", text, re.IGNORECASE) for pattern, _, _ in _UNIT_PATTERNS)


def _unknown_unit(name: str) -> str:
    """The unit in brackets at the end of a name, where it is not known."""
    bracket = _unit_in_bracket(name)
    return "" if bracket is None or _is_known(bracket[1]) else bracket[1]


def _unknown_gain(name: str) -> str:
    """The unit in brackets at the end of a gain's name, where it is not that of the facts."""
    bracket = _BRACKET.search(name)
    if bracket is None or not (_unit_in_bracket(name) or re.search("deg|°", bracket[1].lower())):
        return ""
    return "" if _SI_GAIN.fullmatch(re.sub(r"[ _.·⋅*-]", "", bracket[1].lower())) else bracket[1]


def _joints_like_units(columns: Iterable[str]) -> set[str]:
    """Columns with a joint in brackets that looks like a unit: ``pos[LB]`` beside ``pos[LF]``."""
    series: dict[str, dict[str, str]] = {}
    for column in columns:
        bracket = _BRACKET.search(column)
        if bracket is None or not re.fullmatch(r"\w+", bracket[1]) or _is_known(bracket[1]):
            continue
        outside = column[: bracket.start()].strip()
        if set(words(outside)) <= _SERIES | _GENERIC:
            series.setdefault(outside, {})[bracket[1]] = column
    return {column for by in series.values() if len(by) > 1 for column in by.values()}


def _unit(name: str) -> tuple[str, str, str]:
    """Unit, the quantity that it is of, and the name without it."""
    for source in (name, re.sub(r"[_.]", " ", name)):
        for pattern, quantity, unit in _UNIT_PATTERNS:
            if found := re.search(pattern, source, re.IGNORECASE):
                return unit, quantity, f"{name[: found.start()]} {name[found.end() :]}"
    return "", "", name


def match(label: str, names: Sequence[str]) -> tuple[str, float] | None:
    """The joint that a label means and how surely (0 to 1); None where it means none, or more than one equally."""
    scored = sorted(((_likeness(label, name), name) for name in names), reverse=True)
    if not scored or scored[0][0] == 0.0 or (len(scored) > 1 and scored[0][0] == scored[1][0]):
        return None
    return scored[0][1], scored[0][0]


def _likeness(label: str, name: str) -> float:
    if label == name:
        return 1.0
    if label.casefold() == name.casefold() or words(label) == words(name):
        return 0.99
    one, other = joint_words(label), joint_words(name)
    if "".join(one) == "".join(other):
        return 0.95
    if set(other) <= set(one):
        return 0.9 - 0.01 * len(set(one) - set(other))
    if set(one) <= set(other) and not all(word.isdigit() for word in one):
        return 0.8 - 0.01 * len(set(other) - set(one))
    return 0.0


def is_other(label: str) -> bool:
    """Whether a label has words of other things than joints, such as ``foot``."""
    return not _OTHER.isdisjoint(words(label))


def only_numbers(labels: Iterable[str]) -> bool:
    """Whether labels identify joints by numbers alone."""
    return all(all(word.isdigit() for word in joint_words(label)) for label in labels)
