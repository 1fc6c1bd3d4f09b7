"""Would AFM help this robot? A policy under faults of its actuators, without AFM and with it.

  afm-rl-compare Hopper-v5 policy.zip                          nine faults; a table, a page
  afm-rl-compare Hopper-v5 policy.onnx --faults "one reversed" "late 2"
  afm-rl-compare Hopper-v5 policy.zip --methods AFM "least squares" oracle --episodes 10

The robot is the id of a gymnasium environment, and the model is its own, of MuJoCo; for others use
`afm_rl.compare` in Python. The policy is a file: a model of Stable-Baselines3, an ONNX file, or a
file of `save_policy`; without a file, actions are random. The page, a figure and the numbers are
written to `outputs/compare/ENV`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from afm_rl.cli.error_messages import OneLineParser, errors_in_one_line
from afm_rl.errors import ConfigurationError
from afm_rl.imports import RUN, check_installed, without_collection


def main() -> None:
    """Run ``afm-rl-compare``; a mistake ends with one line of text and status 2."""
    parser = OneLineParser("afm-rl-compare", __doc__)
    add = parser.add_argument
    add("env", metavar="ENV", help="id of a gymnasium environment")
    add(
        "policy",
        metavar="POLICY",
        nargs="?",
        type=Path,
        help="file; by default random actions",
    )
    add("--normaliser", metavar="FILE", type=Path, help="file of VecNormalize.save, with a zip")
    add("--faults", metavar="NAME", nargs="+", help="such as 'one reversed' (nine faults)")
    add("--methods", metavar="NAME", nargs="+", default=["AFM"], help="AFM, least squares, oracle")
    add("--episodes", type=int, default=3, help="episodes of each fault and method (3)")
    add("--steps", type=int, help="largest number of steps of an episode (that of ENV)")
    add("--at", type=int, help="steps before the fault (a fifth of an episode)")
    add("--residual-steps", type=int, default=0, help="healthy steps to fit the model to (0)")
    add("--seed", type=int, default=0, help="seed of the first episode (0)")
    add("--out", metavar="DIR", type=Path, help="folder for the results (outputs/compare/ENV)")
    options = parser.parse_args()
    with errors_in_one_line(parser.prog):
        _run(options)


def _run(options: argparse.Namespace) -> None:
    """Compare, print the table and write the page."""
    check_installed("afm-rl-compare", *RUN)
    with without_collection():  # torch takes seconds: `--help` need not wait
        import torch

        from afm_rl import compare
        from afm_rl.planning import policy_from_sb3
        from afm_rl.storage.files import file_name
    torch.set_num_threads(1)
    policy = options.policy
    if options.normaliser is not None:
        if policy is None or policy.suffix != ".zip":
            raise ConfigurationError(
                f"--normaliser={options.normaliser}: expected beside a model of Stable-Baselines3, "
                "a zip; give it as POLICY"
            )
        policy = policy_from_sb3(policy, options.normaliser)
    names = "faults", "methods", "episodes", "steps", "at", "residual_steps", "seed"
    found = compare(options.env, policy, **{name: getattr(options, name) for name in names})
    print(f"\n{found}")
    folder = options.out or Path("outputs/compare") / file_name(options.env)
    found.save(folder)
    print(f"\nwrote {folder / 'index.html'}")


if __name__ == "__main__":
    main()
