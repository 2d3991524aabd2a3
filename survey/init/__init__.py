"""survey.toml written from what a folder of photographs holds."""
