//! What any device of the network answers to the question where the coordinator is. What is
//! read names a few services, each with a few addresses, and no control symbol.

#![no_main]

#[path = "../../../coordinator/cli/lan/dns.rs"]
mod dns;

const KIND: &str = "_terrafarm._tcp.local.";

terrafarm_fuzz::target!(seeds(), accepts);

/// An answer with a service and its address; names that came before are referred to.
fn seeds() -> Vec<Vec<u8>> {
    let mut packet = dns::question(7, KIND);
    packet[2] = 0x84;
    packet[7] = 1;
    packet[11] = 1;
    packet.extend(b"\x05tower\xc0\x0c\x00\x21\x80\x01\x00\x00\x00\x0a\x00\x14");
    packet.extend(b"\x00\x00\x00\x00\x1b\x9e\x06office\x05local\x00");
    packet
        .extend(b"\x06office\x05local\x00\x00\x01\x80\x01\x00\x00\x00\x0a\x00\x04\x0a\x4e\x00\x01");
    vec![packet]
}

fn accepts(input: &[u8]) -> bool {
    if input.len() > dns::PACKET_MAX {
        return false;
    }
    let found = dns::answers(input, KIND);
    assert!(found.len() <= 16);
    for service in &found {
        assert!((1..=4).contains(&service.addresses.len()));
        assert!(service.addresses.is_sorted());
        assert!(!service.name.chars().any(char::is_control));
    }
    found.iter().any(|service| service.port != 0)
}
