"""Folders of results become one table, :class:`Runs`; tables, figures and films are views of it."""

from afm_rl.report.comparison import draw_comparison
from afm_rl.report.film import check_video, write_films
from afm_rl.report.learning import draw_learning
from afm_rl.report.runs import Runs, read_runs
from afm_rl.report.space_plot import draw_space
from afm_rl.report.statistics import summarise
from afm_rl.report.tables import print_summary
from afm_rl.report.trajectory import draw_trajectories, load_tracks
from afm_rl.report.write import write_events, write_report, write_run

__all__ = [
    "Runs",
    "check_video",
    "draw_comparison",
    "draw_learning",
    "draw_space",
    "draw_trajectories",
    "load_tracks",
    "print_summary",
    "read_runs",
    "summarise",
    "write_events",
    "write_films",
    "write_report",
    "write_run",
]
