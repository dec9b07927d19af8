//! The secure channel under a link: Noise `NNpsk0` with the farm token as the key that
//! both sides share. No I/O, no clock.
//!
//! Each side sends one opening of [`OPENING_BYTES`], [`PREAMBLE`] first; the preamble is
//! bound into the handshake. Who has not the token cannot make an opening that the other
//! side takes, nor read or write a record after it. Fresh keys of each connection mean
//! that a token that is stolen later opens nothing that was recorded before.
//!
//! ```text
//! record  u16, little-endian: length of what follows, 17 to 65535 bytes
//!         ciphertext by ChaCha20-Poly1305; the last 16 bytes are its tag
//! ```
//! The nonce of a record is its number, which does not travel: a record that is changed,
//! repeated, left out or moved does not open, and none after it. Where one record ends
//! and the next one begins means nothing to the messages inside. A stream that is cut
//! between two records is noticed by the messages, as on a plain link.
//!
//! Source: The Noise Protocol Framework, revision 34, sections 7.4 and 9; crate `snow`.

use super::token::FarmToken;
use bytes::{Buf, BufMut, BytesMut};
use snow::{HandshakeState, StatelessTransportState};
use std::sync::Arc;

/// The first bytes of a secure link; those of a plain one are [`crate::frame::MAGIC`].
pub(super) const MAGIC: [u8; 4] = *b"TFRS";
/// Version of the channel, apart from that of the protocol inside it.
const VERSION: u16 = 1;
/// Magic and version, little-endian.
pub(super) const PREAMBLE: [u8; 6] = {
    let ([m0, m1, m2, m3], [v0, v1]) = (MAGIC, VERSION.to_le_bytes());
    [m0, m1, m2, m3, v0, v1]
};
/// Length of the proof after the preamble, bytes: an X25519 key and the tag of nothing.
pub(super) const PROOF_BYTES: usize = 32 + TAG_BYTES;
/// Length of an opening, bytes: preamble and proof.
pub(super) const OPENING_BYTES: usize = PREAMBLE.len() + PROOF_BYTES;

const PATTERN: &str = "Noise_NNpsk0_25519_ChaChaPoly_BLAKE2s";
const TAG_BYTES: usize = 16;
const LENGTH_BYTES: usize = 2;
/// Longest ciphertext of a record with its tag, bytes: the longest message of Noise.
const SEALED_MAX: usize = u16::MAX as usize;
/// Longest plaintext of a record, bytes.
pub(super) const RECORD_MAX: usize = SEALED_MAX - TAG_BYTES;
/// Longest record, bytes: what a receiver holds before it opens it.
pub(super) const RECORD_BYTES_MAX: usize = LENGTH_BYTES + SEALED_MAX;

/// What is wrong with a secure channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum ChannelError {
    /// An opening that was not made with this token.
    #[error("the peer does not prove the farm token")]
    Unproven,
    /// A length that no record has.
    #[error("the peer sent a record of {0} bytes, which is too short for one")]
    Length(u16),
    /// A record that is not the next one of this connection.
    #[error("a record was changed, repeated, left out or moved on its way")]
    Tampered,
    /// A key for more than 2^64 - 2 records, or no randomness for one.
    #[error("the system gives no key for a secure link")]
    NoKey,
}

/// The side that connects, between its opening and the answer.
pub(super) struct Opening(HandshakeState);

impl Opening {
    /// Begins a channel: what to send.
    pub fn new(token: &FarmToken) -> Result<(Self, [u8; OPENING_BYTES]), ChannelError> {
        let builder = builder(token);
        Opening::begin(builder.build_initiator().map_err(|_| ChannelError::NoKey)?)
    }

    fn begin(mut state: HandshakeState) -> Result<(Self, [u8; OPENING_BYTES]), ChannelError> {
        let bytes = write_opening(&mut state)?;
        Ok((Opening(state), bytes))
    }

    /// The proof that came back, its preamble read already.
    pub fn finish(mut self, proof: &[u8; PROOF_BYTES]) -> Result<(Sealer, Opener), ChannelError> {
        read_proof(&mut self.0, proof)?;
        halves(self.0)
    }
}

/// The other side: takes the proof of a peer, its preamble read already, and says what to
/// send back. The peer has proved that it knows the token now, but it may repeat what
/// someone else sent: only a record that opens shows that it is alive.
pub(super) fn answer(
    token: &FarmToken,
    proof: &[u8; PROOF_BYTES],
) -> Result<([u8; OPENING_BYTES], Sealer, Opener), ChannelError> {
    answer_by(builder(token).build_responder().map_err(|_| ChannelError::NoKey)?, proof)
}

fn answer_by(
    mut state: HandshakeState,
    proof: &[u8; PROOF_BYTES],
) -> Result<([u8; OPENING_BYTES], Sealer, Opener), ChannelError> {
    read_proof(&mut state, proof)?;
    let bytes = write_opening(&mut state)?;
    let (sealer, opener) = halves(state)?;
    Ok((bytes, sealer, opener))
}

fn builder(token: &FarmToken) -> snow::Builder<'_> {
    let params = PATTERN.parse().expect("the name of the pattern is one that snow knows");
    let builder = snow::Builder::new(params).prologue(&PREAMBLE);
    builder.and_then(|builder| builder.psk(0, token.key())).expect("each is set once")
}

fn write_opening(state: &mut HandshakeState) -> Result<[u8; OPENING_BYTES], ChannelError> {
    let mut bytes = [0; OPENING_BYTES];
    bytes[..PREAMBLE.len()].copy_from_slice(&PREAMBLE);
    let proof = &mut bytes[PREAMBLE.len()..];
    let written = state.write_message(&[], proof).map_err(|_| ChannelError::NoKey)?;
    debug_assert_eq!(written, PROOF_BYTES);
    Ok(bytes)
}

fn read_proof(state: &mut HandshakeState, proof: &[u8]) -> Result<(), ChannelError> {
    state.read_message(proof, &mut []).map(drop).map_err(|_| ChannelError::Unproven)
}

fn halves(state: HandshakeState) -> Result<(Sealer, Opener), ChannelError> {
    let keys = state.into_stateless_transport_mode().map_err(|_| ChannelError::NoKey)?;
    let keys = Arc::new(keys);
    Ok((Sealer { keys: keys.clone(), number: 0 }, Opener { keys, number: 0 }))
}

/// Makes records.
#[derive(Debug)]
pub(super) struct Sealer {
    keys: Arc<StatelessTransportState>,
    /// Of the next record.
    number: u64,
}

impl Sealer {
    /// Appends bytes as records of [`RECORD_MAX`] each, the last one shorter; none for no
    /// bytes.
    pub fn seal(&mut self, plain: &[u8], records: &mut BytesMut) -> Result<(), ChannelError> {
        for piece in plain.chunks(RECORD_MAX) {
            let length = piece.len() + TAG_BYTES;
            records.put_u16_le(length as u16);
            let start = records.len();
            records.resize(start + length, 0);
            let sealed = self.keys.write_message(self.number, piece, &mut records[start..]);
            sealed.map_err(|_| ChannelError::NoKey)?;
            self.number = self.number.checked_add(1).ok_or(ChannelError::NoKey)?;
        }
        Ok(())
    }
}

/// Opens records.
#[derive(Debug)]
pub(super) struct Opener {
    keys: Arc<StatelessTransportState>,
    /// Of the next record.
    number: u64,
}

impl Opener {
    /// Takes one record off the front of what has arrived and appends what is inside;
    /// `false` while it is not whole. After an error the channel is of no more use.
    pub fn open(
        &mut self,
        arrived: &mut BytesMut,
        plain: &mut BytesMut,
    ) -> Result<bool, ChannelError> {
        let Some(length) = arrived.first_chunk().map(|bytes| u16::from_le_bytes(*bytes)) else {
            return Ok(false);
        };
        let sealed_len = usize::from(length);
        if sealed_len <= TAG_BYTES {
            return Err(ChannelError::Length(length));
        }
        let Some(sealed) = arrived.get(LENGTH_BYTES..LENGTH_BYTES + sealed_len) else {
            return Ok(false);
        };
        let start = plain.len();
        plain.resize(start + sealed_len - TAG_BYTES, 0);
        if self.keys.read_message(self.number, sealed, &mut plain[start..]).is_err() {
            plain.truncate(start);
            return Err(ChannelError::Tampered);
        }
        self.number = self.number.checked_add(1).ok_or(ChannelError::NoKey)?;
        arrived.advance(LENGTH_BYTES + sealed_len);
        Ok(true)
    }
}

#[cfg(test)]
mod tests;
