//! Where the task is: locations from topics, in whatever frame, in the order in which they came; and the transforms
//! that some of them wait for.

use std::sync::atomic::Ordering::SeqCst;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use ros2_client::MessageInfo;

use super::super::lifecycle::Lifecycle;
use super::super::messages::geometry_msgs::{PointStamped, PoseStamped};
use super::super::messages::tf2_msgs::TFMessage;
use super::{Shared, lock};
use crate::serving::{ErrorCode, GivenLocation, Refusal};

/// A location of the task, as it came on a topic.
pub(super) struct Given {
    location: String,
    point: PointStamped,
    /// Whether it came as a goal pose, which asks for a trajectory.
    pub(super) is_goal: bool,
    received: Instant,
    /// Which time that the node was active it came in; none where it was not.
    activation: Option<u64>,
    /// How much longer than others it was on its way (s).
    delay_secs: f64,
}

impl Given {
    fn what(&self) -> &str {
        if self.is_goal { "goal" } else { &self.location }
    }

    fn may_wait(&self, refusal: &Refusal) -> bool {
        !self.point.header.frame_id.is_empty() && may_come(refusal)
    }
}

/// Whether a refusal is for want of a transform that may still come.
pub(super) fn may_come(refusal: &Refusal) -> bool {
    matches!(refusal.code, ErrorCode::FrameUnknown | ErrorCode::TransformFailed)
}

/// Deals with the locations that wait for transforms, one after the other.
async fn work_off(shared: Weak<Shared>) {
    loop {
        let Some(shared) = shared.upgrade() else { return };
        let first = lock(&shared.waiting).front().map(|given| given.received);
        let Some(received) = first else { return };
        let located = shared
            .once_heard(received, |shared| match lock(&shared.waiting).front() {
                Some(given) if given.received == received => shared.locate(given).map(Some),
                // Another one took its place.
                _ => Ok(None),
            })
            .await;
        let done = match located {
            Ok(None) => continue,
            Ok(Some(location)) => Ok(location),
            Err(refusal) => Err(refusal),
        };
        // Carried out before the next one may be, so that they count in their order.
        let mut waiting = lock(&shared.waiting);
        if waiting.front().is_some_and(|given| given.received == received)
            && let Some(given) = waiting.pop_front()
        {
            shared.carry_out(&given, done);
        }
    }
}

impl Shared {
    /// A goal pose sets the first location of the task, and asks for a trajectory.
    pub(super) fn goal_pose(self: &Arc<Self>, goal: PoseStamped, info: &MessageInfo) {
        let location = self.state().server.goal_location().to_owned();
        let PoseStamped { header, pose } = goal;
        self.given(location, PointStamped { header, point: pose.position }, true, info);
    }

    /// A location of the task; it asks for a trajectory only with `publish_on_task`.
    pub(super) fn task_location(
        self: &Arc<Self>,
        location: &str,
        point: PointStamped,
        info: &MessageInfo,
    ) {
        self.given(location.to_owned(), point, false, info);
    }

    /// Takes note of a location, now if it is known where it is; else when it is, or not at all. Those that come
    /// after one that waits wait for their turn, so that they count in their order.
    fn given(
        self: &Arc<Self>,
        location: String,
        point: PointStamped,
        is_goal: bool,
        info: &MessageInfo,
    ) {
        let activation = self.state().activation();
        let delay_secs = lock(&self.delays).hear(info);
        let received = Instant::now();
        let given = Given { location, point, is_goal, received, activation, delay_secs };
        let mut waiting = lock(&self.waiting);
        let located = self.locate(&given);
        let waits = matches!(&located, Err(refusal) if given.may_wait(refusal));
        if waiting.is_empty() {
            if waits {
                waiting.push_back(given);
                tokio::spawn(work_off(Arc::downgrade(self)));
            } else {
                self.carry_out(&given, located);
            }
            return;
        }
        // Of those that wait on one topic the last one counts; but the first of all is only given up for one that
        // need not wait, or a quick succession would never come to its turn.
        let same =
            |other: &Given| (&other.location, other.is_goal) == (&given.location, given.is_goal);
        let place = (usize::from(waits)..waiting.len()).find(|i| same(&waiting[*i]));
        if let Some(old) = place.and_then(|place| waiting.remove(place)) {
            log::warn!(
                "{} refused: its transform did not come before a later one took its place",
                old.what()
            );
        }
        waiting.push_back(given);
        drop(waiting);
        self.transforms_heard.notify_waiters();
    }

    fn locate(&self, given: &Given) -> Result<GivenLocation, Refusal> {
        let PointStamped { header, point } = &given.point;
        self.frames.location(&lock(&self.tree), &given.location, header, point)
    }

    /// What becomes of a location. Nobody else's may be carried out meanwhile: the caller holds those that wait.
    fn carry_out(self: &Arc<Self>, given: &Given, located: Result<GivenLocation, Refusal>) {
        let (publish, max_delay_secs) = {
            let state = self.state();
            (given.is_goal || state.publish_on_task, state.max_delay_secs)
        };
        let done = located.and_then(|location| {
            // Nobody expects the arm to move for it any more.
            if publish && max_delay_secs > 0.0 && given.delay_secs > max_delay_secs {
                let delay = given.delay_secs;
                return Err(Refusal::new(
                    ErrorCode::StaleTask,
                    format!(
                        "it came {delay:.1} s late, as when the network was gone; task.max_delay_s is \
                         {max_delay_secs:.1} s; publish it again"
                    ),
                ));
            }
            self.set_location(&location, publish)?;
            match publish {
                true => self.publish_latest(given.received, given.activation),
                false => Ok(()),
            }
        });
        if let Err(refusal) = done {
            lock(&self.counts).turned_away(&refusal);
            log::warn!("{} refused: {refusal}", given.what());
        }
    }

    /// Tries something that needs transforms until it works, or the time for which they are waited is over.
    pub(super) async fn once_heard<T>(
        &self,
        received: Instant,
        attempt: impl Fn(&Self) -> Result<T, Refusal>,
    ) -> Result<T, Refusal> {
        let timeout = Duration::from_secs_f64(self.state().tf_timeout_secs);
        loop {
            let heard = self.transforms_heard.notified();
            tokio::pin!(heard);
            heard.as_mut().enable();
            match attempt(self) {
                Err(refusal) if may_come(&refusal) => {
                    let left = timeout.saturating_sub(received.elapsed());
                    if tokio::time::timeout(left, heard).await.is_err() {
                        let message = format!(
                            "{} (waited for {:.1} s, tf.timeout_s)",
                            refusal.message,
                            timeout.as_secs_f64()
                        );
                        return Err(Refusal { message, ..refusal });
                    }
                }
                done => return done,
            }
        }
    }

    /// Transforms of `/tf`, or of `/tf_static`.
    pub(super) fn transforms(&self, message: &TFMessage, is_static: bool) {
        {
            let mut tree = lock(&self.tree);
            for transform in &message.transforms {
                if let Err(complaint) = tree.hear(transform, is_static) {
                    log::warn!("{complaint}");
                }
            }
        }
        self.transforms_heard.notify_waiters();
    }

    /// Takes note of a location, and of whether it asks for a motion.
    fn set_location(&self, location: &GivenLocation, publish: bool) -> Result<(), Refusal> {
        let now_secs = self.now_secs();
        let mut state = self.state();
        if let Lifecycle::Unconfigured | Lifecycle::Finalized = state.lifecycle {
            return Err(self.not_active(state.lifecycle));
        }
        state.server.set_location(&location.name, location.xy, now_secs)?;
        if publish {
            self.goals_asked.fetch_add(1, SeqCst);
        }
        log::debug!("{} is ({:.3}, {:.3})", location.name, location.xy[0], location.xy[1]);
        Ok(())
    }
}
