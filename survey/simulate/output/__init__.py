"""A staged scene becomes a survey folder: photographs, what a reconstruction may know, and the truth beside it."""
