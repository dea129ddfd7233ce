//! How long messages were on their way. A network that is gone for a while delivers, when it is back, what was sent
//! meanwhile; a goal among it is not what anybody wants by then.
//!
//! Clocks of two machines differ, so a message's delay is counted from that of the quickest message of the same
//! participant.

use std::collections::BTreeMap;

use ros2_client::builtin_interfaces::Time;
use ros2_client::{Gid, MessageInfo};

/// Participants that are remembered; with more, all are forgotten.
const MOST: usize = 1000;
/// Nanoseconds by which the offset of two clocks may seem to change from one message to the next.
const STEADY: i64 = 200_000_000;
/// Nanoseconds between two messages that do not come out of the same backlog.
const APART: i64 = 1_000_000_000;

/// What is known of the ways from others.
#[derive(Debug, Default)]
pub struct Delays {
    known: BTreeMap<[u8; 12], Way>,
}

#[derive(Debug)]
struct Way {
    /// The smallest time from sending to receipt, by two clocks (ns).
    least: i64,
    /// Of those that took long, and as long as the last one, the first: when it was received, and how long it took (ns).
    slow: Option<(i64, i64)>,
}

impl Delays {
    /// How much longer than the quickest message of its participant took one that comes now (s); 0 for the first one,
    /// and for those that do not say when they were sent.
    pub fn hear(&mut self, message: &MessageInfo) -> f64 {
        // By the system's clock, also where `/clock` is for stamps.
        let received = Time::now().to_nanos();
        let sent = message.source_timestamp();
        sent.map_or(0.0, |sent| self.take(message.publisher_gid(), sent.to_nanos(), received))
    }

    /// The same.
    ///
    /// # Arguments
    /// * `sent`, `received`: nanoseconds, each by the clock of its machine
    fn take(&mut self, publisher: Gid, sent: i64, received: i64) -> f64 {
        let mut participant = [0; 12];
        participant.copy_from_slice(&publisher.to_bytes16()[..12]);
        let took = received.saturating_sub(sent);
        if self.known.len() >= MOST && !self.known.contains_key(&participant) {
            self.known.clear();
        }
        let way = self.known.entry(participant).or_insert(Way { least: took, slow: None });
        // Of a backlog all come at once. Two that come apart and took as long as each other were sent by a clock that
        // was set meanwhile.
        let alike = way.slow.filter(|(_, before)| took.abs_diff(*before) < STEADY.unsigned_abs());
        if alike.is_some_and(|(then, _)| received.saturating_sub(then) > APART) {
            way.least = took;
        }
        way.least = way.least.min(took);
        let delay = took.saturating_sub(way.least);
        way.slow = (delay > STEADY).then_some(alike.unwrap_or((received, took)));
        delay as f64 * 1e-9
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: i64 = 1_000_000_000;

    fn gid(participant: u8, writer: u8) -> Gid {
        let mut bytes = [participant; 16];
        bytes[15] = writer;
        rustdds::GUID::from_bytes(bytes).into()
    }

    #[test]
    fn a_delay_is_counted_from_the_quickest_message_whatever_the_clocks_say() {
        for offset in [-3600 * SECOND, 0, 5 * SECOND] {
            let mut delays = Delays::default();
            let mut hear =
                |writer, sent, received| delays.take(gid(1, writer), sent, received + offset);
            assert_eq!(hear(1, 0, 1_000_000), 0.0);
            assert!(hear(1, SECOND, SECOND + 2_000_000) < 0.002);
            // Three that were sent while the network was gone, by two writers.
            assert!((hear(1, 10 * SECOND, 19 * SECOND) - 9.0).abs() < 0.01);
            assert!((hear(2, 12 * SECOND, 19 * SECOND) - 7.0).abs() < 0.01);
            assert!((hear(2, 18 * SECOND, 19 * SECOND) - 1.0).abs() < 0.01);
            assert!(hear(1, 20 * SECOND, 20 * SECOND + 500_000) < 0.001);
        }
    }

    #[test]
    fn a_clock_that_was_set_is_taken_after_one_message() {
        let mut delays = Delays::default();
        let mut hear = |sent, received| delays.take(gid(1, 1), sent, received);
        assert_eq!(hear(100 * SECOND, 100 * SECOND), 0.0);
        // It is ten seconds behind from here on.
        assert!(hear(110 * SECOND, 120 * SECOND) > 9.9);
        assert!(hear(113 * SECOND, 123 * SECOND) < 0.01);
        assert!(hear(114 * SECOND, 124 * SECOND) < 0.01);
    }

    #[test]
    fn a_clock_that_was_set_is_taken_in_a_stream_of_goals_and_a_backlog_is_not() {
        let tick = SECOND / 10;
        let mut delays = Delays::default();
        let mut hear = |sent, received| delays.take(gid(1, 1), sent, received);
        assert_eq!(hear(0, 0), 0.0);
        let backlog: Vec<f64> = (1..100).map(|i| hear(i * tick, 100 * tick)).collect();
        assert!(backlog.iter().filter(|delay| **delay > 5.0).count() >= 49, "{backlog:?}");
        let set: Vec<f64> = (101..150).map(|i| hear(i * tick, i * tick + 30 * SECOND)).collect();
        assert!(set[0] > 29.0 && set[12..].iter().all(|delay| *delay < 0.01), "{set:?}");
    }

    #[test]
    fn others_do_not_matter_and_nobody_is_remembered_for_ever() {
        let mut delays = Delays::default();
        delays.take(gid(1, 1), 0, 0);
        assert_eq!(delays.take(gid(2, 1), 0, 50 * SECOND), 0.0);
        for sender in 0..=MOST {
            let mut bytes = [0; 16];
            bytes[..8].copy_from_slice(&sender.to_be_bytes());
            delays.take(rustdds::GUID::from_bytes(bytes).into(), 0, 0);
        }
        assert!(delays.known.len() <= MOST);
        assert!(delays.take(gid(1, 1), i64::MIN, i64::MAX) >= 0.0);
    }
}
