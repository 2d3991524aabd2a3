"""Bed beside and below the edges of what stands over it, where no window of the sweep fits between them."""
