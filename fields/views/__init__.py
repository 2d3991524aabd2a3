"""Novel views of photographs with height maps."""
