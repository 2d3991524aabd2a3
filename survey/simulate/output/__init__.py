"""A staged scene becomes a survey folder: photographs, the inputs of a reconstruction, and the ground truth."""
