"""A vehicle for other simulators: a folder for C MuJoCo, or one file of plain numpy."""
