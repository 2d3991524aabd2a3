"""Surveys with known truth: a bed, water and a flight become photographs, and the truth is written beside them.

`scene_file` reads the settings; `light`, `water` and `sensor` describe conditions. `ground` holds shapes and their
colours, `flight` the cameras, `render` computes the light along rays (exactly, or by path tracing), and `output` writes
the survey folder. Two packages combine them: `staging`, for the command ``simulate``, from a scene file; `drawn`, for
the small survey of the demo and the tests, from a few parameters.
"""
