"""Robots: model, initial state and drives."""

from pace_envs.robots.anymal_d import ANYMAL_D_JOINTS, anymal_d_cfg
from pace_envs.robots.go2 import GO2_JOINTS, go2_cfg
from pace_envs.robots.so101 import SO101_JOINTS, so101_cfg
from pace_envs.robots.test_bench import TEST_BENCH_JOINTS, apply_test_bench_load, test_bench_cfg

__all__ = [
    "ANYMAL_D_JOINTS",
    "GO2_JOINTS",
    "SO101_JOINTS",
    "TEST_BENCH_JOINTS",
    "anymal_d_cfg",
    "apply_test_bench_load",
    "go2_cfg",
    "so101_cfg",
    "test_bench_cfg",
]
