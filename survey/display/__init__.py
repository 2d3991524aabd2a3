"""Display of results: colours, the grid of a plan view, quantities as text, and words that sentences share."""
