"""The result of an adjustment: parameters with verdicts, poses, and standard deviations of heights."""
