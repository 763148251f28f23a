"""Adds the folder `configs` to the package, as nlt/configs; everything else is in pyproject.toml."""

from setuptools import find_packages, setup

setup(packages=[*find_packages(include=["nlt*"]), "nlt.configs"], package_dir={"nlt.configs": "configs"})
