//! Whom a side of a link trusts: with a farm token, links are encrypted and both sides
//! prove that they have it; without one they are plain, and that only on this PC or where
//! the user has said so.

use super::HandshakeError;
use super::token::FarmToken;
use std::net::IpAddr;

/// Whom a side of a link trusts.
#[derive(Debug, Clone)]
pub enum Trust {
    /// Whoever proves this token, wherever it is; plain links are refused.
    Token(FarmToken),
    /// Whoever is on this PC, over plain links; nobody else.
    Loopback,
    /// Everyone who can reach this PC, over plain links: a network that the user trusts.
    Network,
}

impl Trust {
    /// The token that a link with a peer at an address has to prove; `None` is a plain
    /// link.
    ///
    /// # Errors
    /// [`HandshakeError::NoToken`] if there has to be one and there is none.
    pub fn token_for(&self, peer: IpAddr) -> Result<Option<&FarmToken>, HandshakeError> {
        match self {
            Trust::Token(token) => Ok(Some(token)),
            Trust::Network => Ok(None),
            Trust::Loopback if is_this_pc(peer) => Ok(None),
            Trust::Loopback => Err(HandshakeError::NoToken),
        }
    }
}

/// Whether an address is one that only this PC can reach.
pub fn is_this_pc(address: IpAddr) -> bool {
    address.to_canonical().is_loopback()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn links_are_plain_on_this_pc_alone_unless_the_user_says_so() {
        let here = ["127.0.0.1", "127.8.0.1", "::1", "::ffff:127.0.0.1"];
        let elsewhere = ["192.168.0.7", "0.0.0.0", "::", "fe80::1", "::ffff:10.0.0.1"];
        let of = |text: &&str| -> IpAddr { text.parse().expect("an address") };
        for peer in here.iter().map(of) {
            assert!(matches!(Trust::Loopback.token_for(peer), Ok(None)), "{peer}");
        }
        for peer in elsewhere.iter().map(of) {
            let refused = Trust::Loopback.token_for(peer);
            assert!(matches!(refused, Err(HandshakeError::NoToken)), "{peer}");
        }
        let token = Trust::Token(FarmToken::from_bytes([7; 32]));
        for peer in here.iter().chain(&elsewhere).map(of) {
            assert!(matches!(Trust::Network.token_for(peer), Ok(None)), "{peer}");
            assert!(matches!(token.token_for(peer), Ok(Some(_))), "{peer}");
        }
    }
}
