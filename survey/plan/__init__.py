"""The plan: the decisions for a survey with reasons, its cost, and its faults, before anything is computed."""
