"""The verb simulate: a scene file is planned, staged and photographed."""
