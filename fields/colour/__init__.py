"""The colour of the water, estimated from views that look through different lengths of it, and the bed without it."""
