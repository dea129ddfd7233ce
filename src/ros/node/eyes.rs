//! What people look at: diagnostics, and a ghost of the robot that plays the motion.

use std::collections::VecDeque;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use ros2_client::builtin_interfaces::Time as StampTime;
use tokio::sync::watch;
use tokio::time::MissedTickBehavior;

use super::super::messages::builtin_interfaces::Time;
use super::super::messages::diagnostic_msgs::{DiagnosticArray, DiagnosticStatus, KeyValue};
use super::super::messages::sensor_msgs::JointState;
use super::super::messages::std_msgs::Header;
use super::{Shared, lock, with};
use crate::serving::{Refusal, SampleReply};
use crate::trajectory::JointTrajectory;

/// Latencies that the diagnostics' quantiles are of.
const LATENCIES: usize = 200;
/// Joint states of the ghost in a second.
const PREVIEW_HZ: f64 = 30.0;

/// What came of requests so far.
#[derive(Debug, Default)]
pub(super) struct Counts {
    requests: u64,
    samples: u64,
    refused: u64,
    published: u64,
    /// Whether the last request was refused.
    last_refused: bool,
    /// Why the last one that was refused was so.
    last_error: Option<String>,
    /// Times from requests to answers, ms, the latest last.
    millis: VecDeque<f64>,
}

impl Counts {
    pub(super) fn answered(&mut self, reply: &SampleReply, took: Duration) {
        self.requests += 1;
        self.samples += reply.samples.len() as u64;
        self.last_refused = reply.refusal.is_some();
        if let Some(refusal) = &reply.refusal {
            self.refused += 1;
            self.last_error = Some(refusal.to_string());
        }
        if self.millis.len() == LATENCIES {
            self.millis.pop_front();
        }
        self.millis.push_back(1e3 * took.as_secs_f64());
    }

    /// A request that was refused before anybody looked for a motion.
    pub(super) fn turned_away(&mut self, refusal: &Refusal) {
        self.requests += 1;
        self.refused += 1;
        self.last_refused = true;
        self.last_error = Some(refusal.to_string());
    }

    pub(super) fn published(&mut self) {
        self.published += 1;
    }

    /// The value below which that share of the latest latencies lies, ms.
    fn quantile(&self, share: f64) -> Option<f64> {
        let mut sorted: Vec<f64> = self.millis.iter().copied().collect();
        sorted.sort_by(f64::total_cmp);
        let rank = (share * sorted.len() as f64) as usize;
        sorted.get(rank.min(sorted.len().saturating_sub(1))).copied()
    }
}

/// A time as messages have it.
pub(super) fn message_time(time: StampTime) -> Time {
    let nanos = time.to_nanos();
    Time {
        sec: i32::try_from(nanos.div_euclid(1_000_000_000)).unwrap_or(i32::MAX),
        nanosec: nanos.rem_euclid(1_000_000_000) as u32,
    }
}

/// Tells once a second how the node is.
pub(super) async fn diagnose(shared: Weak<Shared>) {
    let mut second = tokio::time::interval(Duration::from_secs(1));
    second.set_missed_tick_behavior(MissedTickBehavior::Skip);
    loop {
        second.tick().await;
        let sent = with(&shared, |shared| {
            let (stamp, status) = (message_time(shared.stamp()), shared.diagnostic());
            let header = Header { stamp, frame_id: String::new() };
            let array = DiagnosticArray { header, status: vec![status] };
            if let Err(e) = shared.diagnostics.publish(array) {
                log::debug!("diagnostics could not be sent: {e}");
            }
        });
        if sent.is_none() {
            return;
        }
    }
}

/// Plays each motion that comes, at the speed at which the arm would make it.
pub(super) async fn preview(
    shared: Weak<Shared>,
    mut motions: watch::Receiver<Option<Arc<JointTrajectory>>>,
) {
    while motions.changed().await.is_ok() {
        let Some(motion) = motions.borrow_and_update().clone() else { continue };
        let began = Instant::now();
        let mut frame = tokio::time::interval(Duration::from_secs_f64(1.0 / PREVIEW_HZ));
        frame.set_missed_tick_behavior(MissedTickBehavior::Skip);
        loop {
            tokio::select! {
                changed = motions.changed() => {
                    if changed.is_err() {
                        return;
                    }
                    // The next one begins at once.
                    motions.mark_changed();
                    break;
                }
                _ = frame.tick() => {}
            }
            let elapsed = began.elapsed().as_secs_f64();
            if with(&shared, |shared| shared.show(&motion, elapsed)).is_none() {
                return;
            }
            if motion.times_secs.last().is_none_or(|end| elapsed >= *end) {
                break;
            }
        }
    }
}

impl Shared {
    fn show(&self, motion: &JointTrajectory, secs: f64) {
        let (mut name, mut position) = (motion.joint_names.clone(), motion.at(secs));
        for (other, at) in &self.state().server.robot().others {
            name.push(other.clone());
            position.push(*at);
        }
        let header = Header { stamp: message_time(self.stamp()), frame_id: String::new() };
        let joints = JointState { header, name, position, ..JointState::default() };
        if let Err(e) = self.preview.publish(joints) {
            log::debug!("the preview could not be sent: {e}");
        }
    }

    fn diagnostic(&self) -> DiagnosticStatus {
        let (description, lifecycle, publish_on_task) = {
            let state = self.state();
            (state.server.describe(), state.lifecycle, state.publish_on_task)
        };
        let waiting = lock(&self.waiting).len();
        let counts = lock(&self.counts);
        let millis = |share| match counts.quantile(share) {
            Some(millis) => format!("{millis:.2}"),
            None => "-".into(),
        };
        let state = lifecycle.state().label;
        let (level, message) = match &counts.last_error {
            Some(error) if counts.last_refused => {
                (DiagnosticStatus::WARN, format!("{state}; the last request was refused: {error}"))
            }
            _ => (DiagnosticStatus::OK, format!("{state}, {}", description.primitive)),
        };
        let values = [
            ("state", state),
            ("model", description.model_id),
            ("method", description.method),
            ("synthetic data", description.synthetic_data.to_string()),
            ("publish_on_task", publish_on_task.to_string()),
            ("requests", counts.requests.to_string()),
            ("samples", counts.samples.to_string()),
            ("refused", counts.refused.to_string()),
            ("published", counts.published.to_string()),
            ("waiting for transforms", waiting.to_string()),
            ("latency median, ms", millis(0.5)),
            ("latency 99th percentile, ms", millis(0.99)),
            ("last error", counts.last_error.clone().unwrap_or_else(|| "none".into())),
        ];
        let values = values.map(|(key, value)| KeyValue { key: key.into(), value });
        DiagnosticStatus {
            level,
            name: format!("{}: serving", self.names.fully_qualified().trim_start_matches('/')),
            message,
            hardware_id: description.robot,
            values: values.into(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_of_the_latest_requests() {
        let mut counts = Counts::default();
        assert_eq!(counts.quantile(0.5), None);
        let reply = SampleReply { samples: Vec::new(), refusal: None, model_id: String::new() };
        for i in 0..300 {
            counts.answered(&reply, Duration::from_millis(i));
        }
        assert_eq!((counts.requests, counts.millis.len()), (300, LATENCIES));
        assert!((counts.quantile(0.5).unwrap() - 200.0).abs() < 1e-9);
        assert!((counts.quantile(0.99).unwrap() - 298.0).abs() < 1e-9);
    }
}
