"""The mathematics, on NumPy arrays: no Prefect, no Arrow, no files, no clocks."""
