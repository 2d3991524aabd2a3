"""The survey field: a tensor field in a thin slab about the bed, trained inside the bound of the sweep."""
