//! Whether a device still answers: a stream that falls silent may be a quiet bus, or a device that is gone without a word.
//!
//! The reader asks for the time now and then; a device that leaves all of it unanswered is given up. Only time in which the
//! reader was there to hear counts, so that a computer that slept, or had other things to do, accuses nobody.

use std::time::Duration;

/// How often the device's time is asked for.
const ASK_EVERY: Duration = Duration::from_millis(500);
/// A device that has answered nothing for this long is given up. With [`ASK_EVERY`] before it, that is within two seconds of
/// its last answer.
const PATIENCE: Duration = Duration::from_millis(1400);
/// A pass takes as long as a read waits, about 50 ms. What is longer, the reader was not there.
const LONGEST_PASS: Duration = Duration::from_millis(100);

/// What the reader is to do next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Next {
    /// Nothing.
    Listen,
    /// Ask for the time.
    Ask,
    /// Nothing has been answered for this long.
    GiveUp(Duration),
}

/// Counts the silence.
#[derive(Clone, Copy, Debug, Default)]
pub struct SilenceWatch {
    since_asked: Duration,
    /// Since the first question behind the last answer.
    unanswered: Option<Duration>,
}

impl SilenceWatch {
    /// Time has passed; `answered` if anything was in it, refusals among it.
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

    /// How long the watch takes to give up, in passes of one length.
    fn gives_up_after(pass: Duration, answered: impl Fn(u32) -> bool) -> Option<Duration> {
        let mut watch = SilenceWatch::default();
        (1..1000).find(|at| matches!(watch.pass(pass, answered(*at)), Next::GiveUp(_))).map(|at| pass * at)
    }

    #[test]
    fn a_device_that_answers_nothing_is_given_up_within_two_seconds() {
        // Whenever its last answer was.
        for last in 1..20 {
            let given_up = gives_up_after(PASS, |at| at == last).unwrap();
            assert!(given_up <= PASS * last + Duration::from_secs(2), "{given_up:?} for {last}");
        }
        assert_eq!(gives_up_after(PASS, |at| at % 20 == 0), None);
    }

    #[test]
    fn time_in_which_nobody_listened_accuses_nobody() {
        // A computer that slept for an hour, and one on which each pass takes a second.
        let mut watch = SilenceWatch::default();
        while watch.pass(PASS, false) != Next::Ask {}
        assert_ne!(watch.pass(Duration::from_hours(1), false), Next::GiveUp(Duration::from_hours(1)));
        assert!(gives_up_after(Duration::from_secs(1), |_| false) > Some(Duration::from_secs(10)));
    }
}
