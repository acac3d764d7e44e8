"""Datasets: nights of Parquet tables in a folder or an object store, published as a whole."""
