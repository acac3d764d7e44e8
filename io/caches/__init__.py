"""What is kept on disk between runs: arrays and compiled kernels."""
