//! Every limit of the protocol, in one place. The encoder refuses what the decoder
//! would refuse, so a limit is never discovered by the other side.

#[cfg(doc)]
use terrafarm_common::accuracy::KEPT_MAX;
use terrafarm_common::camera::MAX_SIDE_PX;
use terrafarm_common::id::MAX_SHOT_FRAMES;

/// The oldest protocol version this program speaks.
pub const OLDEST_VERSION: u16 = 1;
/// The newest protocol version this program speaks.
pub const NEWEST_VERSION: u16 = 1;

/// Longest head of a handshake message, bytes.
pub const HELLO_HEAD_MAX: usize = 4 << 10;
/// Longest head of a control message, bytes: [`WANT_BLOBS_MAX`] hashes are 32 KiB.
pub const CONTROL_HEAD_MAX: usize = 64 << 10;
/// Longest head of a submission message, bytes: [`CAMERAS_MAX`] cameras are 118 KiB.
pub const SUBMISSION_HEAD_MAX: usize = 160 << 10;
/// Longest head of a message that carries a blob behind it.
pub const BLOB_HEAD_MAX: usize = 1 << 10;
/// Longest head of a message that carries pixels behind it: a summary of their errors
/// keeps at most [`KEPT_MAX`] values of 14 bytes, 56 KiB.
pub const PIXELS_HEAD_MAX: usize = 64 << 10;
/// Longest head of a request to the API or of its answer, bytes.
pub const DESK_HEAD_MAX: usize = 4 << 10;
/// Longest payload of one frame, bytes. Longer payloads travel in parts of this size, so
/// that a heartbeat waits for one part at most: 9 ms on gigabit Ethernet.
pub const PART_BYTES: usize = 1 << 20;
/// Longest blob, bytes. Tiles have a few hundred kilobytes; the index of a store has
/// about 55 bytes a tile, so this is a store of nearly five million tiles.
pub const BLOB_BYTES_MAX: usize = 256 << 20;
/// Longest picture or piece of one, bytes: the largest frame, uncompressed.
pub const PIXEL_BYTES_MAX: usize = MAX_SIDE_PX as usize * MAX_SIDE_PX as usize * 3;

/// Longest body of a request to the API or of its answer, bytes: a submission of some
/// hundred thousand cameras. Longer contents are fetched by range.
pub const DESK_BODY_MAX: usize = 256 << 20;
/// Longest path of a request, its query included, bytes.
pub const PATH_BYTES_MAX: usize = 2 << 10;
/// Longest content type of an answer, bytes.
pub const CONTENT_TYPE_BYTES_MAX: usize = 128;

/// Longest name of a program, a worker, a client or a shot, bytes of UTF-8.
pub const NAME_BYTES_MAX: usize = 256;
/// Longest reason, bytes of UTF-8.
pub const REASON_BYTES_MAX: usize = 2 << 10;
/// Most blobs asked for in one message.
pub const WANT_BLOBS_MAX: usize = 1024;
/// Most workers named as having a blob.
pub const ELSEWHERE_MAX: usize = 4;
/// Most cameras told ahead: 118 bytes each.
pub const AHEAD_CAMERAS_MAX: usize = 64;
/// Most leases handed back in one message.
pub const HAND_BACK_MAX: usize = 1024;
/// Most cameras in one message.
pub const CAMERAS_MAX: usize = 1024;
/// Most frames of a shot.
pub const FRAMES_MAX: u32 = MAX_SHOT_FRAMES;
/// Most finished frames that may wait for a client.
pub const FRAMES_IN_FLIGHT_MAX: u32 = 1024;
/// Most workers named in the summary of a shot: 128 of the longest names are 34 KiB.
pub const WORKER_SHARES_MAX: usize = 128;
/// Most render threads of one worker.
pub const THREADS_MAX: u32 = 4096;

/// What a message is for; each class has its own limits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Class {
    /// The first messages of a connection: all that a stranger may send.
    Hello,
    /// Small messages that keep the farm going.
    Control,
    /// What a client asks for.
    Submission,
    /// A message with a blob behind it.
    Blob,
    /// A message with pixels behind it.
    Pixels,
    /// A request to the API, or its answer, with a body behind it.
    Desk,
}

impl Class {
    /// Longest head, bytes.
    pub fn head_max(self) -> usize {
        match self {
            Class::Hello => HELLO_HEAD_MAX,
            Class::Control => CONTROL_HEAD_MAX,
            Class::Submission => SUBMISSION_HEAD_MAX,
            Class::Blob => BLOB_HEAD_MAX,
            Class::Pixels => PIXELS_HEAD_MAX,
            Class::Desk => DESK_HEAD_MAX,
        }
    }

    /// Longest payload, all parts together, bytes.
    pub fn payload_max(self) -> usize {
        match self {
            Class::Hello | Class::Control | Class::Submission => 0,
            Class::Blob => BLOB_BYTES_MAX,
            Class::Pixels => PIXEL_BYTES_MAX,
            Class::Desk => DESK_BODY_MAX,
        }
    }
}

/// Shortens a reason to [`REASON_BYTES_MAX`] bytes at a character boundary: a report of
/// a failure must not fail because it is long.
pub fn clip_reason(reason: &str) -> String {
    clip(reason, REASON_BYTES_MAX)
}

/// Shortens a name to [`NAME_BYTES_MAX`] bytes at a character boundary.
pub fn clip_name(name: &str) -> String {
    clip(name, NAME_BYTES_MAX)
}

fn clip(text: &str, limit: usize) -> String {
    text[..text.floor_char_boundary(limit)].to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_texts_are_cut_between_characters() {
        let text = "é".repeat(REASON_BYTES_MAX);
        let clipped = clip_reason(&format!("a{text}"));
        assert_eq!(clipped.len(), REASON_BYTES_MAX - 1);
        assert_eq!(clip_reason("short"), "short");
        assert_eq!(clip_name(&"x".repeat(1000)).len(), NAME_BYTES_MAX);
    }

    #[test]
    fn every_length_fits_its_field_of_the_header() {
        for class in [
            Class::Hello,
            Class::Control,
            Class::Submission,
            Class::Blob,
            Class::Pixels,
            Class::Desk,
        ] {
            assert!(u32::try_from(class.head_max()).is_ok());
            assert!(u32::try_from(class.payload_max()).is_ok());
        }
    }
}
