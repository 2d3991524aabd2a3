"""Structure from motion: poses in the local frame for a survey that comes without them."""
