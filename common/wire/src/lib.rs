//! The protocol between coordinator and worker.
