"""How alike two images are: by formula, or to a trained network whose weights the user supplies."""
