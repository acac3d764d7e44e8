"""Time: scales, the order of frames, the grid of epochs."""
