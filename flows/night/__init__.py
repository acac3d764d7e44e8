"""The steps of the nightly flow: choice of logs, stages, progress, summary."""
