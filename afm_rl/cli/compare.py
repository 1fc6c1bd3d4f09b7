"""Would AFM help this robot? A policy under faults of its actuators, without AFM and with it.

  afm-rl-compare Hopper-v5 policy.zip                          nine faults; a table, a page
  afm-rl-compare Hopper-v5 policy.onnx --faults "one reversed" "late 2"
  afm-rl-compare Hopper-v5 policy.zip --methods AFM "least squares" oracle --episodes 10

The robot is the id of a gymnasium environment, and the model is its own, of MuJoCo: for others use
`afm_rl.compare` in Python. The policy is a file: a model of Stable-Baselines3, ONNX, or what
`save_policy` wrote; without one, actions are random. The page, a figure and the numbers are written
to `outputs/compare/ENV`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from afm_rl.cli.error_messages import OneLineParser, errors_in_one_line
from afm_rl.errors import ConfigurationError
from afm_rl.imports import RUN, check_installed, without_collection


def main() -> None:
    """Run ``afm-rl-compare``; a mistake ends in one line and exit status 2."""
    parser = OneLineParser("afm-rl-compare", __doc__)
    add = parser.add_argument
    add("env", metavar="ENV", help="id of a gymnasium environment")
    add("policy", metavar="POLICY", nargs="?", type=Path, help="file; random actions if left out")
    add("--normaliser", metavar="FILE", type=Path, help="of a zip: what VecNormalize.save wrote")
    add("--faults", metavar="NAME", nargs="+", help="of presets, such as 'one reversed' (nine)")
    add("--methods", metavar="NAME", nargs="+", default=["AFM"], help="AFM, least squares, oracle")
    add("--episodes", type=int, default=3, help="of each fault and method (3)")
    add("--steps", type=int, help="of an episode, at most (as many as the environment has)")
    add("--at", type=int, help="steps before the fault (a fifth of an episode)")
    add("--residual-steps", type=int, default=0, help="healthy steps to fit the model to (0)")
    add("--seed", type=int, default=0, help="of the first episode (0)")
    add("--out", metavar="DIR", type=Path, help="where to (outputs/compare/ENV)")
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
