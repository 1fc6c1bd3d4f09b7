"""Join results of runs, sweeps and studies; write tables (CSV), figures and one HTML page.

  afm-rl-report outputs/demo                       one run: report in outputs/demo/report
  afm-rl-report multirun/NAME                      a sweep: methods named after what is swept
  afm-rl-report study_a study_b --out report       several folders, joined
  afm-rl-report study --baselines physics          compare every method with physics
  afm-rl-report study --no-figures                 tables only, in seconds
  afm-rl-report outputs/demo --video gif           films only, in report/video

A folder is what `afm-rl` has written: missions.csv and measures.json, and steps.parquet for curves,
maps and recovery times. A study may still be running: the report takes what is finished, and says
which methods, scenarios and seeds are missing (missing.csv). Where a job's folder was deleted, it
says so and ends with status 2. Of a mission that stands in several folders, the last one counts.
"""

from __future__ import annotations

from pathlib import Path

from afm_rl.cli.error_messages import OneLineParser, errors_in_one_line
from afm_rl.errors import ArtefactError
from afm_rl.imports import RUN, check_installed, without_collection


def main() -> None:
    """Run ``afm-rl-report``; a mistake ends with one line of text and exit status 2."""
    parser = OneLineParser("afm-rl-report", __doc__)
    add = parser.add_argument
    add("folders", metavar="FOLDER", nargs="+", type=Path, help="results of a run or a study")
    add(
        "--out",
        metavar="DIR",
        type=Path,
        help="folder for the report (FOLDER/report of the first FOLDER)",
    )
    add(
        "--baselines",
        metavar="METHOD",
        nargs="+",
        help="methods to compare with (online_pe and adaptive_affine, if available)",
    )
    add(
        "--oracle", metavar="METHOD", default="oracle", help="method that knows the regime (oracle)"
    )
    add("--no-figures", dest="figures", action="store_false", help="write tables only")
    films = "write only films of the methods' first missions (mp4: an extra)"
    add("--video", choices=("gif", "mp4"), help=films)
    options = parser.parse_args()

    out = options.out or options.folders[0] / "report"
    chosen = {"baselines": options.baselines, "oracle": options.oracle, "figures": options.figures}
    with errors_in_one_line(parser.prog):
        check_installed("reports", *RUN)
        with without_collection():  # torch takes seconds: `--help` need not wait
            from afm_rl.envs import load_track
            from afm_rl.film import check_video
            from afm_rl.report import load_tracks, read_runs, write_films, write_report

        form, runs = check_video(options.video or False), read_runs(options.folders)
        tracks = load_tracks(runs.missions["track"].unique(), load_track)
        if form:
            write_films(out / "video", runs, tracks, form)
        else:
            write_report(runs, out, tracks, **chosen)
        if runs.lost:
            raise ArtefactError("; ".join(runs.lost))


if __name__ == "__main__":
    main()
