"""Occupancy grids, which are baselines of experiments and maps for everybody."""

from gmmtorch.occupancy import LogOdds as LogOdds
from gmmtorch.occupancy import OccupancyGrid as OccupancyGrid
