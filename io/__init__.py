"""Everything that reads or writes files: logs, datasets, catalogues, caches, the work area."""
