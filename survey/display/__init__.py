"""How results are shown: colours, the grid of a plan view, and quantities as text."""
