"""Pictures of a problem and its result; matplotlib is imported when something is drawn."""

from lmdsl.plotting.closed_loop import trajectories as trajectories
from lmdsl.plotting.page import figure as figure
from lmdsl.plotting.plots import causes as causes
from lmdsl.plotting.plots import control as control
from lmdsl.plotting.plots import cost as cost
from lmdsl.plotting.plots import measure as measure
from lmdsl.plotting.plots import portrait as portrait
