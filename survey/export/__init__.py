"""Products of a finished run for other programs: `registry` lists them, one file per family writes them."""
