"""Package list and folder map; everything else is in pyproject.toml."""

from setuptools import find_packages, setup

FOLDERS = {
    "afm_rl": "afm_rl",
    "afm_rl.envs": "envs",
    "afm_rl.conf": "conf",
    "afm_rl.play.policies": "examples/policies/zoo",  # those that the page plays, by pyproject.toml
}

packages = [
    ".".join(filter(None, (root, sub)))
    for root, folder in FOLDERS.items()
    for sub in ("", *find_packages(folder))
]

setup(packages=packages, package_dir=FOLDERS)
