"""What pyproject.toml cannot say: find the packages, and install the folder assets/ as `pace_assets`."""

from setuptools import find_packages, setup

CODE = find_packages(include=["pace_actuators*", "pace_envs*", "pace_optim*"])

setup(
    packages=[*CODE, "pace_assets"],
    package_dir={"pace_assets": "assets"},
    package_data={
        "": ["py.typed"],
        "pace_optim": ["**/*.html", "**/*.css", "**/*.js"],  # the report's templates
        "pace_assets": ["**/*"],
    },
    exclude_package_data={"pace_assets": ["**/__pycache__/*", "__pycache__/*"]},
)
