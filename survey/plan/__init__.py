"""The plan: what a survey needs and why, what it will cost, and what is wrong with it, before anything is computed."""
