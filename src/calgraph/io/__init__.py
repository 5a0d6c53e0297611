"""Files: atomic writes, YAML, archives of arrays, tables, the folder of the cache, and what a signal ends."""
