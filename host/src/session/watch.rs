//! Detects that a device no longer answers: a silent stream may be a quiet bus, or a device that went away without notice.
//!
//! The reader regularly asks for the time; a device that answers none of these requests is given up. Only time in which the
//! reader was listening counts, so a computer that slept or was busy blames no device.

use std::time::Duration;

/// How often to ask for the device's time.
const ASK_EVERY: Duration = Duration::from_millis(500);
/// A device that has answered nothing for this long is given up. With [`ASK_EVERY`] added, that is within two seconds of its
/// last answer.
const PATIENCE: Duration = Duration::from_millis(1400);
/// A pass takes as long as a read waits, about 50 ms. During the rest of a longer pass, the reader was not
/// listening.
pub const LONGEST_PASS: Duration = Duration::from_millis(100);

/// What the reader should do next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Next {
    /// Just listen.
    Listen,
    /// Ask for the time.
    Ask,
    /// Nothing has been answered for this long.
    GiveUp(Duration),
}

/// Measures the silence.
#[derive(Clone, Copy, Debug, Default)]
pub struct SilenceWatch {
    since_asked: Duration,
    /// Since the first request after the last answer.
    unanswered: Option<Duration>,
}

impl SilenceWatch {
    /// Accounts for time that has passed; `answered` if any answer arrived in it, even a refusal.
    pub fn pass(&mut self, passed: Duration, answered: bool) -> Next {
        let passed = passed.min(LONGEST_PASS);
        self.since_asked += passed;
        match &mut self.unanswered {
            _ if answered => self.unanswered = None,
            Some(unanswered) => *unanswered += passed,
            None => {}
        }
        if let Some(unanswered) = self.unanswered.filter(|unanswered| *unanswered >= PATIENCE) {
            return Next::GiveUp(unanswered);
        }
        if self.since_asked < ASK_EVERY {
            return Next::Listen;
        }
        self.since_asked = Duration::ZERO;
        self.unanswered.get_or_insert_default();
        Next::Ask
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PASS: Duration = Duration::from_millis(50);

    /// How long the watch takes to give up, with passes of equal length.
    fn gives_up_after(pass: Duration, answered: impl Fn(u32) -> bool) -> Option<Duration> {
        let mut watch = SilenceWatch::default();
        (1..1000).find(|at| matches!(watch.pass(pass, answered(*at)), Next::GiveUp(_))).map(|at| pass * at)
    }

    #[test]
    fn a_device_that_answers_nothing_is_given_up_within_two_seconds() {
        // Whenever the last answer came.
        for last in 1..20 {
            let given_up = gives_up_after(PASS, |at| at == last).unwrap();
            assert!(given_up <= PASS * last + Duration::from_secs(2), "{given_up:?} for {last}");
        }
        assert_eq!(gives_up_after(PASS, |at| at % 20 == 0), None);
    }

    #[test]
    fn time_in_which_nobody_listened_accuses_nobody() {
        // A computer that slept for an hour, and one so busy that each pass takes a second.
        let mut watch = SilenceWatch::default();
        while watch.pass(PASS, false) != Next::Ask {}
        assert_ne!(watch.pass(Duration::from_hours(1), false), Next::GiveUp(Duration::from_hours(1)));
        assert!(gives_up_after(Duration::from_secs(1), |_| false) > Some(Duration::from_secs(10)));
    }
}
