"""Where the model fails: a run's error against its noise floor, frequency, speed, position, load and time.

>>> content = compare(["logs/pace/anymal_d/26_01_01_00-00-00"])
>>> content["worst_places"][0]["sentence"]
"""

from .compare import VERSION, compare, comparison_lines

__all__ = ["VERSION", "compare", "comparison_lines"]
