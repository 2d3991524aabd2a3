"""survey.toml: the settings of a survey, table by table."""
