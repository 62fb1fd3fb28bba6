"""Flights: frames that follow one another are placed together, tracked, and answered live."""
