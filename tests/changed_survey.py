"""A survey with other values of its records."""

from dataclasses import fields, replace

from survey.folder.survey import Survey


def changed(survey: Survey, **values) -> Survey:
    """The survey with other values, each put into the record that has it: ``control`` into its observations.

    ``bounds`` are those of its settings.
    """
    if "bounds" in values:
        area = replace(survey.config.area, bounds=values.pop("bounds"))
        values["config"] = replace(values.get("config", survey.config), area=area)
    for name in ("observations", "provenance", "findings"):
        record = getattr(survey, name)
        own = {field.name: values.pop(field.name) for field in fields(record) if field.name in values}
        values[name] = replace(record, **own)
    return replace(survey, **values)
