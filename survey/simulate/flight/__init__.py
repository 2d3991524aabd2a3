"""Flight planning over water: cameras, coverage of the bed, and whether the block determines the water level."""

from survey.simulate.flight.patterns import FlightSettings, plan_flight

__all__ = ["FlightSettings", "plan_flight"]
