"""The studies that gmmtorch-fit and gmmtorch-occupancy run."""
