//! Playback: moving within a file, and bookmarks.

use super::super::model::{Model, Playing, SourceState};
use super::super::order::Order;
use super::state::{App, View};
use cantap_trace::grammar;

/// How far a key moves, in nanoseconds.
const STEP_NS: i64 = 10_000_000_000;

impl App {
    fn playing(&mut self, model: &Model) -> Option<Playing> {
        if let SourceState::Playing(playing) = model.source {
            return Some(playing);
        }
        "only a file has a position; O opens one".clone_into(&mut self.message);
        None
    }

    /// Moves forward or back by ten seconds.
    pub(super) fn seek_by(&mut self, steps: i64, model: &Model) {
        if let Some(playing) = self.playing(model) {
            self.seek(playing.position_ns.saturating_add(steps * STEP_NS), playing);
        }
    }

    fn seek(&mut self, time_ns: i64, playing: Playing) {
        let last = playing.end_ns.unwrap_or(i64::MAX).max(playing.first_ns);
        // What is shown next is elsewhere.
        self.cursor = None;
        self.frozen = None;
        self.order(Order::Seek(time_ns.clamp(playing.first_ns, last)));
    }

    /// Moves to a time since the beginning, or a fraction of the whole.
    pub(super) fn seek_to(&mut self, text: &str, model: &Model) -> Result<(), String> {
        let Some(playing) = self.playing(model) else { return Ok(()) };
        let ahead = match text.strip_suffix('%') {
            Some(share) => {
                let share = share.trim().parse::<f64>().ok().filter(|share| (0.0..=100.0).contains(share));
                let share = share.ok_or("write a share as 0% to 100%")?;
                let end = playing.end_ns.ok_or("the file's length is not known yet; write a time")?;
                (end.saturating_sub(playing.first_ns) as f64 * share / 100.0) as i64
            }
            None => since_start(text)?,
        };
        self.seek(playing.first_ns.saturating_add(ahead), playing);
        Ok(())
    }

    /// Moves to where the bar was clicked.
    pub(super) fn seek_share(&mut self, share: f64, model: &Model) {
        if let SourceState::Playing(playing @ Playing { end_ns: Some(end), .. }) = model.source {
            let ahead = (end.saturating_sub(playing.first_ns) as f64 * share) as i64;
            self.seek(playing.first_ns.saturating_add(ahead), playing);
        }
    }

    /// Pauses or resumes playback; at the end, restarts it from the beginning.
    pub(super) fn toggle_playback(&mut self, model: &Model) {
        match model.source {
            SourceState::Playing(playing) if playing.ended => {
                self.seek(playing.first_ns, playing);
                if playing.paused {
                    self.order(Order::TogglePause);
                }
            }
            _ => self.order(Order::TogglePause),
        }
    }

    /// Bookmarks the selected record's time, or the position.
    pub(super) fn bookmark(&mut self, model: &Model) {
        let selected = self.cursor.filter(|_| self.view == View::Trace);
        let selected = selected.and_then(|place| model.history.get(place)).map(|record| record.time_ns);
        let position = match model.source {
            SourceState::Playing(playing) => playing.position_ns,
            _ => model.seen.now_ns,
        };
        let time_ns = selected.unwrap_or(position);
        if let Err(place) = self.bookmarks.binary_search(&time_ns) {
            self.bookmarks.insert(place, time_ns);
        }
        self.message = format!("bookmark {} set; {{ and }} go to them", self.bookmarks.len());
    }

    /// Moves to the previous or next bookmark: in a file by playing from there, in a device's records by
    /// selecting one.
    pub(super) fn go_to_bookmark(&mut self, forward: bool, model: &Model) {
        let selected = self.cursor.and_then(|place| model.history.get(place));
        let here = match model.source {
            SourceState::Playing(playing) => playing.position_ns,
            _ => selected.map_or(model.seen.now_ns, |record| record.time_ns),
        };
        let found = if forward {
            self.bookmarks.iter().find(|time_ns| **time_ns > here)
        } else {
            self.bookmarks.iter().rev().find(|time_ns| **time_ns < here)
        };
        let Some(found) = found.copied() else {
            "there is no bookmark that way; B sets one".clone_into(&mut self.message);
            return;
        };
        if let SourceState::Playing(playing) = model.source {
            return self.seek(found, playing);
        }
        self.show(View::Trace);
        self.cursor = model.history.place_at(found);
    }
}

/// `83.5`, `90s`, `2m`, `1:23`, `1:02:03.5`: nanoseconds since the beginning.
fn since_start(text: &str) -> Result<i64, String> {
    const FORM: &str =
        "write a time since the beginning, such as 90s, 1:30 or 1:02:03, or a share, such as 50%";
    let duration = grammar::duration(text).map_err(|_| FORM.to_owned())?;
    Ok(i64::try_from(duration.as_nanos()).unwrap_or(i64::MAX))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_in_a_file_are_told_as_players_do() {
        let at = |text: &str| since_start(text).map(|ns| ns as f64 / 1e9);
        for (text, seconds) in
            [("90s", 90.0), ("2m", 120.0), ("1:30", 90.0), ("1:02:03.5", 3723.5), ("0:00.25", 0.25)]
        {
            assert_eq!(at(text), Ok(seconds), "{text}");
        }
        for wrong in ["", "soon", "1:2:3:4", "1:-2", "1:x"] {
            assert!(at(wrong).unwrap_err().contains("1:30"), "{wrong}");
        }
    }
}
