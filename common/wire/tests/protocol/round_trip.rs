use crate::samples;
use proptest::prelude::*;
use std::collections::BTreeSet;
use terrafarm_wire::limits::NEWEST_VERSION;
use terrafarm_wire::{Message, decode, encode};

pub fn bytes(message: &Message) -> Vec<u8> {
    encode(NEWEST_VERSION, message).unwrap().flat_map(|frame| frame.to_vec()).collect()
}

proptest! {
    #[test]
    fn any_message_arrives_as_it_was_sent(message in samples::any_message()) {
        prop_assert_eq!(decode(&bytes(&message)).unwrap(), vec![message]);
    }

    #[test]
    fn messages_in_a_row_arrive_in_order(messages in prop::collection::vec(samples::any_message(), 0..8)) {
        let stream: Vec<u8> = messages.iter().flat_map(bytes).collect();
        prop_assert_eq!(decode(&stream).unwrap(), messages);
    }
}

#[test]
fn there_is_a_sample_of_every_kind() {
    let sampled: BTreeSet<u16> = samples::all().iter().map(|(_, message)| message.kind()).collect();
    let known: BTreeSet<u16> = Message::KINDS.iter().map(|known| known.0).collect();
    assert_eq!(known.len(), Message::KINDS.len(), "every number is used once");
    assert_eq!(sampled, known);
}
