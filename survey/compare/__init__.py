"""A cloud against a reference, in figures and pictures; nothing is aligned.

`comparison` reads files (`inputs`), measures in one frame (`measure`, with the check points) and returns figures
(`figures`, also as JSON), which are shown as text (`text`) and pictures (`pictures`, on `canvas`); settings: `options`.
"""
