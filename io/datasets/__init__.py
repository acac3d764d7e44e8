"""Datasets: nights of Parquet tables, published at once in a folder or an object store."""
