"""A survey folder read into its local frame: settings, images, poses and water, checked against each other."""
