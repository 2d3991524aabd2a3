"""`bathynerf benchmark`: run time against error, of the whole chain and of what it has to beat.

    cases (surveys with known truth) x methods x qualities x poses -> one process each -> records -> table, picture

`benchmark` is the loop over all of it; `text` has the table and the picture, and compares two results.
"""
