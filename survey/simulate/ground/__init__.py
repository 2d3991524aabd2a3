"""The ground of a scene: shapes that rays meet, their colours, and the light on them in dry air."""
