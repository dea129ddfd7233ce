//! Threads that sample, so that a slow request never holds up parameters, topics or other
//! services.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::mpsc::{SyncSender, TrySendError, sync_channel};
use std::thread;

use crate::serving::{ErrorCode, Refusal};

/// Requests that may wait in one lane.
pub const WAITING: usize = 16;

type Job = Box<dyn FnOnce() + Send>;

/// One thread that does one job after the other. It ends when the lane is dropped; a job that
/// runs at that moment is not waited for.
#[derive(Debug)]
pub struct Lane {
    jobs: SyncSender<Job>,
}

impl Lane {
    /// A lane with a thread of this name.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn new(name: &str) -> std::io::Result<Self> {
        let (jobs, waiting) = sync_channel::<Job>(WAITING);
        thread::Builder::new().name(name.into()).spawn(move || {
            for job in waiting {
                // One broken job must not end the lane; its message is on the terminal.
                let _ = catch_unwind(AssertUnwindSafe(job));
            }
        })?;
        Ok(Self { jobs })
    }

    /// Does a job when those before it are done.
    ///
    /// # Errors
    /// [`ErrorCode::Busy`] when [`WAITING`] jobs wait already.
    pub fn run(&self, job: impl FnOnce() + Send + 'static) -> Result<(), Refusal> {
        self.jobs.try_send(Box::new(job)).map_err(|e| match e {
            TrySendError::Full(_) => Refusal::new(
                ErrorCode::Busy,
                format!("{WAITING} requests wait already, and no more may; ask again shortly"),
            ),
            TrySendError::Disconnected(_) => {
                Refusal::new(ErrorCode::Internal, "the sampling thread has ended; restart the node")
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc::channel;

    #[test]
    fn jobs_are_done_in_order_and_a_panic_ends_only_its_own() {
        let lane = Lane::new("test").unwrap();
        let (done, results) = channel();
        for i in 0..4 {
            let done = done.clone();
            lane.run(move || {
                assert_ne!(i, 1, "this panic is part of the test");
                done.send(i).unwrap();
            })
            .unwrap();
        }
        drop(done);
        assert_eq!(results.iter().collect::<Vec<_>>(), [0, 2, 3]);
    }

    #[test]
    fn a_full_lane_is_busy_and_takes_jobs_again_when_one_is_done() {
        let lane = Lane::new("test").unwrap();
        let (started, has_started) = channel();
        let (go, gone) = channel::<()>();
        lane.run(move || {
            started.send(()).unwrap();
            let _ = gone.recv();
        })
        .unwrap();
        has_started.recv().unwrap();
        for _ in 0..WAITING {
            lane.run(|| {}).unwrap();
        }
        let refusal = lane.run(|| {}).unwrap_err();
        assert_eq!(refusal.code, ErrorCode::Busy);
        assert!(refusal.message.contains("16"), "{refusal}");
        go.send(()).unwrap();
        let mut attempts = 0;
        while lane.run(|| {}).is_err() {
            attempts += 1;
            assert!(attempts < 1000);
            thread::sleep(std::time::Duration::from_millis(1));
        }
    }
}
