"""The MCAP container: records, chunks, channels and the summary, found in a file's bytes."""
