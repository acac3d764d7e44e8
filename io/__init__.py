"""Everything that touches bytes: logs, datasets, catalogues, Earth orientation."""
