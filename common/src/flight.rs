//! Flights: keyframes and the smooth path through them.
