"""Flight planning over water: cameras, coverage of the bed, and whether the block determines the water level."""

from survey.simulate.flight.patterns import plan_flight
from survey.simulate.flight.settings import FlightSettings

__all__ = ["FlightSettings", "plan_flight"]
