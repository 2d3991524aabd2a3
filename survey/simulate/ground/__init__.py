"""The ground of a scene: shapes that rays meet, what they are coloured with, and the light on them in dry air."""
