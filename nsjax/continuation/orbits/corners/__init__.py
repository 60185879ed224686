"""Special points at which the itinerary of an orbit changes."""
