from .comparison import draw_comparison as draw_comparison
from .learning import draw_learning as draw_learning
from .runs import Runs as Runs, read_runs as read_runs
from .space_plot import draw_space as draw_space
from .statistics import summarise as summarise
from .tables import print_summary as print_summary
from .trajectory import draw_trajectories as draw_trajectories, load_tracks as load_tracks
from .write import (
    write_films as write_films,
    write_report as write_report,
    write_run as write_run,
)
