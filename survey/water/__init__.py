"""The water of a survey: its level from measurements on site, its tide, and its index."""
