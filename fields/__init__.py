# Part of bathynerf.
