//! The protocol between the coordinator, its workers and its clients.
//!
//! Read in this order: [`limits`] names every limit, [`message`] says what travels,
//! [`twin`] how shared values are written down, [`pixels`] how pictures are packed,
//! [`frame`] what a message looks like as bytes, [`codec`] turns bytes into messages and
//! back without any I/O, [`link`] is the one module that awaits.
//!
//! One TCP port serves workers and clients. The first message of a connection is a
//! [`message::Hello`]; the answer is a [`message::Welcome`] or a [`message::Refused`].
//! After that either side may send any message of its role at any time; nothing is a
//! reply by position. Whatever a peer sends, it gets an error, never a panic, and
//! nothing is allocated for a length that has not been checked against its limit.
//!
//! Links between PCs are encrypted, and both sides prove that they have the same
//! [`link::FarmToken`] before a message travels.
//!
//! Not here: who may send what when (the worker's session and the coordinator's driver
//! know that), and where a token is kept.

pub mod codec;
pub mod frame;
pub mod limits;
pub mod link;
pub mod message;
pub mod pixels;
pub mod twin;

pub use codec::{Decoder, WireError, decode, encode};
pub use message::Message;
