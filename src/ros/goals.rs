//! The goals of an action server, by the rules of rcl: ids are unique, states lead in one direction, results are
//! kept for a while, and cancelling speaks of one goal, of all, or of those accepted until then.

use std::time::{Duration, Instant};

use ros2_client::action::{
    CancelGoalResponse, GetResultResponse, GoalId, GoalInfo, GoalStatusEnum,
};
use ros2_client::action_msgs::{CancelGoalResponseEnum, GoalStatus, GoalStatusArray};
use ros2_client::builtin_interfaces::Time;

/// How long a result is kept: rcl's default.
const RESULT_KEPT: Duration = Duration::from_secs(10);

/// Goals that may be under way at once; rcl has no bound, but memory does.
pub const AT_ONCE: usize = 16;

/// The goals that are under way, or whose results are still kept. `R` is a result, `C` the way back to a client
/// that waits for one.
#[derive(Debug)]
pub struct Goals<R, C> {
    goals: Vec<Goal<R, C>>,
}

#[derive(Debug)]
struct Goal<R, C> {
    info: GoalInfo,
    status: GoalStatusEnum,
    end: Option<(Instant, R)>,
    waiting: Vec<C>,
}

impl<R, C> Default for Goals<R, C> {
    fn default() -> Self {
        Self { goals: Vec::new() }
    }
}

/// Whether a goal in this state has ended.
fn is_over(status: GoalStatusEnum) -> bool {
    use GoalStatusEnum::{Aborted, Canceled, Succeeded};
    matches!(status, Succeeded | Canceled | Aborted)
}

impl<R: Clone + Default, C> Goals<R, C> {
    /// Takes a new goal; whether it is accepted. It is not if its id is known, or too many are under way.
    pub fn accept(&mut self, goal_id: GoalId, stamp: Time) -> bool {
        let under_way = self.goals.iter().filter(|goal| !is_over(goal.status)).count();
        let is_known = self.goals.iter().any(|goal| goal.info.goal_id == goal_id);
        let accepted = !is_known && under_way < AT_ONCE;
        if accepted {
            self.goals.push(Goal {
                info: GoalInfo { goal_id, stamp },
                status: GoalStatusEnum::Accepted,
                end: None,
                waiting: Vec::new(),
            });
        }
        accepted
    }

    /// Begins a goal. One that is canceled already stays so.
    pub fn begin(&mut self, goal_id: GoalId) {
        if let Some(goal) = self.goal(goal_id)
            && goal.status == GoalStatusEnum::Accepted
        {
            goal.status = GoalStatusEnum::Executing;
        }
    }

    /// Ends a goal; who waited for its result.
    pub fn end(
        &mut self,
        goal_id: GoalId,
        status: GoalStatusEnum,
        result: R,
        now: Instant,
    ) -> Vec<C> {
        match self.goal(goal_id) {
            Some(goal) if !is_over(goal.status) => {
                goal.status = status;
                goal.end = Some((now, result));
                std::mem::take(&mut goal.waiting)
            }
            _ => Vec::new(),
        }
    }

    /// Answers who asks for a result: at once if the goal has ended, or is not known; later if it is under way.
    pub fn result(&mut self, goal_id: GoalId, client: C) -> Option<(C, GetResultResponse<R>)> {
        let unknown = GetResultResponse { status: GoalStatusEnum::Unknown, result: R::default() };
        match self.goal(goal_id) {
            None => Some((client, unknown)),
            Some(goal) => match &goal.end {
                None => {
                    goal.waiting.push(client);
                    None
                }
                Some((_, result)) => {
                    let (status, result) = (goal.status, result.clone());
                    Some((client, GetResultResponse { status, result }))
                }
            },
        }
    }

    /// Answers a request to cancel. Those that it names are to be stopped, and come to their ends later.
    pub fn cancel(&mut self, asked: &GoalInfo) -> CancelGoalResponse {
        let GoalInfo { goal_id, stamp } = asked;
        let (by_id, by_stamp) = (*goal_id != GoalId::ZERO, *stamp != Time::ZERO);
        let is_meant = |info: &GoalInfo| {
            let is_it = info.goal_id == *goal_id;
            match (by_id, by_stamp) {
                (false, false) => true,
                (true, false) => is_it,
                (_, true) => is_it || info.stamp.to_nanos() <= stamp.to_nanos(),
            }
        };
        let mut goals_canceling = Vec::new();
        let mut any_over = false;
        for goal in self.goals.iter_mut().filter(|goal| is_meant(&goal.info)) {
            match goal.status {
                GoalStatusEnum::Accepted | GoalStatusEnum::Executing => {
                    goal.status = GoalStatusEnum::Canceling;
                    goals_canceling.push(goal.info.clone());
                }
                status => any_over |= is_over(status) || status == GoalStatusEnum::Canceling,
            }
        }
        let return_code = match (goals_canceling.is_empty(), by_id && !by_stamp, any_over) {
            (false, ..) | (true, false, _) => CancelGoalResponseEnum::None,
            (true, true, true) => CancelGoalResponseEnum::GoalTerminated,
            (true, true, false) => CancelGoalResponseEnum::UnknownGoal,
        };
        CancelGoalResponse { return_code, goals_canceling }
    }

    /// The states of all goals that are known.
    pub fn statuses(&self) -> GoalStatusArray {
        let status =
            |goal: &Goal<R, C>| GoalStatus { goal_info: goal.info.clone(), status: goal.status };
        GoalStatusArray { status_list: self.goals.iter().map(status).collect() }
    }

    /// Forgets results that were kept long enough.
    pub fn forget(&mut self, now: Instant) {
        self.goals.retain(|goal| {
            goal.end.as_ref().is_none_or(|(end, _)| now.duration_since(*end) < RESULT_KEPT)
        });
    }

    fn goal(&mut self, goal_id: GoalId) -> Option<&mut Goal<R, C>> {
        self.goals.iter_mut().find(|goal| goal.info.goal_id == goal_id)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use GoalStatusEnum as Status;

    type Known = Goals<u32, &'static str>;

    fn time(secs: i64) -> Time {
        Time::from_nanos(secs * 1_000_000_000)
    }

    fn info(goal_id: GoalId, secs: i64) -> GoalInfo {
        GoalInfo { goal_id, stamp: time(secs) }
    }

    fn statuses(goals: &Known) -> Vec<Status> {
        goals.statuses().status_list.iter().map(|goal| goal.status).collect()
    }

    fn three() -> (Known, [GoalId; 3]) {
        let mut goals = Known::default();
        let ids = [(); 3].map(|()| GoalId::new_random());
        for (i, id) in ids.into_iter().enumerate() {
            assert!(goals.accept(id, time(i as i64 + 1)));
        }
        (goals, ids)
    }

    #[test]
    fn an_id_is_accepted_once_and_so_many_at_once() {
        let (mut goals, [first, ..]) = three();
        assert!(!goals.accept(first, time(9)));
        let accepted = (0..2 * AT_ONCE).filter(|_| goals.accept(GoalId::new_random(), time(9)));
        assert_eq!(accepted.count(), AT_ONCE - 3);
        goals.end(first, Status::Succeeded, 1, Instant::now());
        assert!(!goals.accept(first, time(9)), "its result is still kept");
        assert!(goals.accept(GoalId::new_random(), time(9)));
    }

    #[test]
    fn results_come_when_there_are_any_as_often_as_asked_for_and_are_forgotten_later() {
        let (mut goals, [first, second, _]) = three();
        let now = Instant::now();
        assert!(goals.result(first, "a").is_none());
        assert!(goals.result(first, "b").is_none());
        goals.begin(first);
        assert_eq!(goals.end(first, Status::Succeeded, 7, now), ["a", "b"]);
        assert!(goals.end(first, Status::Aborted, 8, now).is_empty(), "it ends once");
        for client in ["c", "d"] {
            let (to, answer) = goals.result(first, client).unwrap();
            assert_eq!((to, answer.status, answer.result), (client, Status::Succeeded, 7));
        }
        goals.forget(now + RESULT_KEPT / 2);
        assert_eq!(statuses(&goals), [Status::Succeeded, Status::Accepted, Status::Accepted]);
        goals.forget(now + RESULT_KEPT);
        assert_eq!(statuses(&goals), [Status::Accepted, Status::Accepted]);
        let (_, answer) = goals.result(first, "e").unwrap();
        assert_eq!((answer.status, answer.result), (Status::Unknown, 0));
        assert!(goals.result(second, "f").is_none());
    }

    #[test]
    fn cancelling_means_one_goal_or_all_or_those_until_then() {
        use CancelGoalResponseEnum as Code;
        let cancel = |goals: &mut Known, asked: &GoalInfo| {
            let answer = goals.cancel(asked);
            (answer.return_code, answer.goals_canceling.len())
        };
        let (mut goals, [first, second, third]) = three();
        assert_eq!(cancel(&mut goals, &info(GoalId::new_random(), 0)), (Code::UnknownGoal, 0));
        assert_eq!(cancel(&mut goals, &info(second, 0)), (Code::None, 1));
        assert_eq!(statuses(&goals), [Status::Accepted, Status::Canceling, Status::Accepted]);
        assert_eq!(cancel(&mut goals, &info(second, 0)), (Code::GoalTerminated, 0));
        goals.begin(second);
        goals.end(second, Status::Canceled, 0, Instant::now());
        assert_eq!(cancel(&mut goals, &info(second, 0)), (Code::GoalTerminated, 0));
        assert_eq!(cancel(&mut goals, &info(GoalId::ZERO, 1)), (Code::None, 1));
        assert_eq!(statuses(&goals), [Status::Canceling, Status::Canceled, Status::Accepted]);

        let (mut goals, _) = three();
        assert_eq!(cancel(&mut goals, &info(GoalId::ZERO, 0)), (Code::None, 3));
        assert_eq!(cancel(&mut goals, &info(GoalId::ZERO, 0)), (Code::None, 0));
        let (mut goals, [_, _, last]) = three();
        assert_eq!(cancel(&mut goals, &info(last, 1)), (Code::None, 2), "that one, and the first");
        assert_ne!(first, third);
    }
}
