"""Flight planning over water: where photographs are taken from, what they see of the bed, and what they can tell."""

from survey.simulate.flight.patterns import plan_flight
from survey.simulate.flight.settings import FlightSettings

__all__ = ["FlightSettings", "plan_flight"]
