"""A cloud against a reference, in figures and pictures; nothing is aligned.

`comparison` reads files (`inputs`, `area`, `checkpoints`), measures in one frame (`scene`, `measure`) and returns
figures (`figures`, `result`), which are shown as text (`text`), JSON (`json_numbers`) and pictures (`pictures`).
"""
