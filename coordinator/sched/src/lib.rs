//! Who renders what, and when: a pure state machine, with its simulator.
