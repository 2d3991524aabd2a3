"""Names of folders and files that several parts of survey have to agree on."""

from __future__ import annotations

# The run folder in a survey folder, where no other is named.
RUN_FOLDER = "bathynerf"
# In a run folder: what structure from motion keeps.
SFM_FOLDER = "sfm"
# Positions of photographs, as OpenDroneMap has them.
GEO_TXT = "geo.txt"
# Where OpenDroneMap looks for control points.
GCP_LIST = "gcp_list.txt"
