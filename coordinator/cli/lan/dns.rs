//! As much of DNS as a question for a service and its answers take (RFC 1035, 6763).
//!
//! Anyone on the network can send an answer: nothing in one is believed further than it was
//! read, and everything in it is bounded.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr};

/// Longest packet that is read, bytes: RFC 6762, section 17.
pub const PACKET_MAX: usize = 9000;
/// Most questions and records of a packet that are read.
const RECORDS_MAX: usize = 256;
/// Most coordinators that one packet may name, and most addresses of each.
const SERVICES_MAX: usize = 16;
const ADDRESSES_MAX: usize = 4;
/// Longest name, bytes, and most of its labels: RFC 1035, section 3.1.
const NAME_MAX: usize = 255;
const LABELS_MAX: usize = 128;

const TYPE_A: u16 = 1;
const TYPE_PTR: u16 = 12;
const TYPE_AAAA: u16 = 28;
const TYPE_SRV: u16 = 33;
const CLASS_IN: u16 = 1;
/// The bits that are the class; the highest one says something else (RFC 6762, section 10.2).
const CLASS_BITS: u16 = 0x7fff;
/// Of the second word: an answer, and the kind of question that it answers.
const IS_ANSWER: u16 = 0x8000;
const OPCODE: u16 = 0x7800;

/// A service that an answer names, and where it is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Service {
    /// Its own name, the first label.
    pub name: String,
    pub port: u16,
    /// Its addresses, IPv4 first: at least one.
    pub addresses: Vec<IpAddr>,
}

/// A question for all services of a kind, such as `_terrafarm._tcp.local.`.
pub fn question(number: u16, service: &str) -> Vec<u8> {
    let mut packet = Vec::with_capacity(64);
    for word in [number, 0, 1, 0, 0, 0] {
        packet.extend(word.to_be_bytes());
    }
    for label in service.split('.') {
        packet.push(label.len() as u8);
        packet.extend(label.as_bytes());
    }
    for word in [TYPE_PTR, CLASS_IN] {
        packet.extend(word.to_be_bytes());
    }
    packet
}

/// The services of a kind that an answer names; none where it is no answer, or ends too soon.
pub fn answers(packet: &[u8], service: &str) -> Vec<Service> {
    let mut found = Vec::new();
    let kind: Name = service.trim_end_matches('.').split('.').map(lower).collect();
    let Some(records) = records(packet) else { return found };
    for record in &records {
        let Data::Service(port, host) = &record.data else { continue };
        let Some((own, rest)) = record.name.split_first() else { continue };
        if *rest != kind[..] || found.len() >= SERVICES_MAX {
            continue;
        }
        let mut addresses: Vec<IpAddr> = records
            .iter()
            .filter(|record| record.name == *host)
            .filter_map(|record| match record.data {
                Data::Address(ip) => Some(ip),
                Data::Service(..) => None,
            })
            .collect();
        addresses.sort();
        addresses.dedup();
        addresses.truncate(ADDRESSES_MAX);
        if !addresses.is_empty() {
            found.push(Service { name: shown(own), port: *port, addresses });
        }
    }
    found
}

/// Labels in lower case, which is how names are compared.
type Name = Vec<Vec<u8>>;

fn lower(label: &str) -> Vec<u8> {
    label.to_ascii_lowercase().into_bytes()
}

/// A label as people see it: it may hold any bytes.
pub fn shown(label: &[u8]) -> String {
    let text = String::from_utf8_lossy(label);
    text.chars().map(|symbol| if symbol.is_control() { '?' } else { symbol }).collect()
}

struct Record {
    name: Name,
    data: Data,
}

enum Data {
    Address(IpAddr),
    /// Port and host.
    Service(u16, Name),
}

/// The addresses and services of an answer.
fn records(packet: &[u8]) -> Option<Vec<Record>> {
    let mut reader = Reader { packet, at: 0 };
    let _number = reader.word()?;
    let flags = reader.word()?;
    if flags & IS_ANSWER == 0 || flags & OPCODE != 0 {
        return None;
    }
    let questions = usize::from(reader.word()?);
    let others = [reader.word()?, reader.word()?, reader.word()?].map(usize::from);
    for _ in 0..questions.min(RECORDS_MAX) {
        reader.name()?;
        reader.take(4)?;
    }
    let mut records = Vec::new();
    for _ in 0..others.into_iter().sum::<usize>().min(RECORDS_MAX) {
        // What was whole before the packet ends is as good as any.
        match reader.record() {
            Some(Some(record)) => records.push(record),
            Some(None) => {}
            None => break,
        }
    }
    Some(records)
}

/// Reads a packet from its start to its end.
struct Reader<'a> {
    packet: &'a [u8],
    at: usize,
}

impl<'a> Reader<'a> {
    fn take(&mut self, count: usize) -> Option<&'a [u8]> {
        let end = self.at.checked_add(count)?;
        let taken = self.packet.get(self.at..end)?;
        self.at = end;
        Some(taken)
    }

    fn word(&mut self) -> Option<u16> {
        self.take(2).map(|bytes| u16::from_be_bytes([bytes[0], bytes[1]]))
    }

    /// A record, or nothing in the place of one that says nothing to us.
    fn record(&mut self) -> Option<Option<Record>> {
        let name = self.name()?;
        let (kind, class) = (self.word()?, self.word()?);
        let lives = self.take(4)?.iter().any(|&byte| byte != 0);
        let length = usize::from(self.word()?);
        let begin = self.at;
        let bytes = self.take(length)?;
        // A record that lives no longer says that its service is gone.
        if class & CLASS_BITS != CLASS_IN || !lives {
            return Some(None);
        }
        let data = match kind {
            TYPE_A => <[u8; 4]>::try_from(bytes).ok().map(|ip| Ipv4Addr::from(ip).into()),
            TYPE_AAAA => <[u8; 16]>::try_from(bytes).ok().map(|ip| Ipv6Addr::from(ip).into()),
            TYPE_SRV => {
                // Behind priority and weight.
                let mut service = Reader { packet: self.packet, at: begin + 4 };
                let (port, host) = (service.word()?, service.name()?);
                return Some(Some(Record { name, data: Data::Service(port, host) }));
            }
            _ => None,
        };
        Some(data.map(|ip| Record { name, data: Data::Address(ip) }))
    }

    /// A name, which may end in another place of the packet. Each jump leads further to the
    /// front, so that none leads round in circles.
    fn name(&mut self) -> Option<Name> {
        let mut name = Name::new();
        let mut length = 0;
        let (mut at, mut end) = (self.at, None);
        let mut bound = self.at;
        loop {
            let first = usize::from(*self.packet.get(at)?);
            match first >> 6 {
                0 if first == 0 => {
                    self.at = end.unwrap_or(at + 1);
                    return Some(name);
                }
                0 => {
                    let label = self.packet.get(at + 1..at + 1 + first)?;
                    length += 1 + first;
                    if length > NAME_MAX || name.len() >= LABELS_MAX {
                        return None;
                    }
                    name.push(label.to_ascii_lowercase());
                    at += 1 + first;
                }
                3 => {
                    let to = (first & 0x3f) << 8 | usize::from(*self.packet.get(at + 1)?);
                    if to >= bound {
                        return None;
                    }
                    end.get_or_insert(at + 2);
                    (at, bound) = (to, to);
                }
                _ => return None,
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;
    use proptest::prelude::*;

    const KIND: &str = "_terrafarm._tcp.local.";

    /// An answer as a responder sends it: names after the first one are references.
    fn answer(name: &str, ttl: u32) -> Vec<u8> {
        let mut packet = question(7, KIND);
        packet[2] = 0x84;
        // One answer, one additional record.
        packet[7] = 1;
        packet[11] = 1;
        packet.push(name.len() as u8);
        packet.extend(name.as_bytes());
        packet.extend([0xc0, 12]);
        let record = |packet: &mut Vec<u8>, kind: u16, data: &[u8]| {
            packet.extend(kind.to_be_bytes());
            packet.extend((CLASS_IN | 0x8000).to_be_bytes());
            packet.extend(ttl.to_be_bytes());
            packet.extend((data.len() as u16).to_be_bytes());
            packet.extend(data);
        };
        let host = b"\x05tower\x05local\x00";
        let service = [&[0, 0, 0, 0, 0x1b, 0x9e][..], host].concat();
        record(&mut packet, TYPE_SRV, &service);
        packet.extend(b"\x05Tower\x05LOCAL\x00");
        record(&mut packet, TYPE_A, &[10, 78, 0, 1]);
        packet
    }

    #[test]
    fn an_answer_names_the_service_its_port_and_its_addresses() {
        let found = answers(&answer("Office-7070", 10), KIND);
        let addresses = vec![IpAddr::from([10, 78, 0, 1])];
        assert_eq!(found, [Service { name: "office-7070".into(), port: 7070, addresses }]);
        assert!(answers(&answer("office-7070", 0), KIND).is_empty(), "it says goodbye");
        assert!(answers(&answer("office-7070", 10), "_printer._tcp.local.").is_empty());
        assert!(answers(&question(7, KIND), KIND).is_empty(), "a question is no answer");
    }

    #[test]
    fn a_name_of_garbage_is_shown_without_what_moves_a_cursor() {
        let found = answers(&answer("a\u{1b}[2J\nb", 10), KIND);
        assert_eq!(found[0].name, "a?[2j?b");
    }

    #[test]
    fn a_name_that_refers_to_itself_or_forward_ends_the_reading() {
        for to in [12, 14, 200] {
            let mut packet = question(7, KIND);
            packet.truncate(12);
            packet[2] = 0x84;
            packet[5] = 1;
            packet.extend([1, b'a', 0xc0, to, 0, 12, 0, 1]);
            assert!(answers(&packet, KIND).is_empty());
        }
    }

    #[test]
    fn one_packet_names_so_many_services_and_no_more() {
        let mut packet = answer("a", 10);
        let record = packet[39..].to_vec();
        let services = 100;
        (0..services).for_each(|_| packet.extend(&record));
        packet[6..8].copy_from_slice(&(2 * services as u16).to_be_bytes());
        assert_eq!(answers(&packet, KIND).len(), SERVICES_MAX);
    }

    proptest! {
        #[test]
        fn no_packet_panics_and_what_is_cut_names_at_most_what_was_whole(
            at in 0usize..120, byte in any::<u8>(), cut in 0usize..120,
        ) {
            let mut packet = answer("office", 10);
            if let Some(old) = packet.get_mut(at) {
                *old = byte;
            }
            packet.truncate(cut);
            prop_assert!(answers(&packet, KIND).len() <= 1);
        }

        #[test]
        fn bytes_of_any_kind_do_no_harm(bytes in prop::collection::vec(any::<u8>(), 0..600)) {
            let mut packet = bytes;
            let _unread = answers(&packet, KIND);
            if packet.len() > 2 {
                packet[2] = 0x84;
            }
            prop_assert!(answers(&packet, KIND).len() <= SERVICES_MAX);
        }
    }
}
