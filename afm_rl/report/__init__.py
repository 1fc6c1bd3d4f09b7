"""What runs leave behind, tables, figures, TensorBoard events, and reports on many of them."""

from afm_rl.report.comparison import draw_comparison
from afm_rl.report.console import print_summary
from afm_rl.report.events import write_events
from afm_rl.report.film import check_video, film_results, write_films
from afm_rl.report.folder import write_run
from afm_rl.report.learning import draw_learning
from afm_rl.report.space_plot import draw_space
from afm_rl.report.summary import summarise, summarise_cells
from afm_rl.report.trajectory import draw_trajectories
from afm_rl.report.write import write_report

__all__ = [
    "check_video",
    "draw_comparison",
    "draw_learning",
    "draw_space",
    "draw_trajectories",
    "film_results",
    "print_summary",
    "summarise",
    "summarise_cells",
    "write_events",
    "write_films",
    "write_report",
    "write_run",
]
