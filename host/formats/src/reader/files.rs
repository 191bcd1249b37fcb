//! A trace of several files, which are read one after another: a bag of ROS 2 in its folder.

use std::path::Path;

use super::{Beyond, OpenError, TraceReader, head_of, open_file};
use crate::input::Input;
use crate::issue::{Fault, Place};
use crate::read_options::ReadOptions;
use crate::ros::folder;

impl TraceReader {
    /// Opens the files of a bag in a folder.
    pub(super) fn of_folder(path: &Path, options: &ReadOptions) -> Result<Self, OpenError> {
        let files = folder::files(path).map_err(|error| OpenError::Io(path.display().to_string(), error))?;
        let mut reader = open_file(&files.first, options)?;
        reader.others = files.others;
        if !files.has_metadata {
            reader.notes.note(folder::NO_METADATA);
        }
        Ok(reader)
    }

    /// Goes on with the next file of the recording. One that cannot be opened is an issue, and does not keep from those behind it.
    pub(super) fn begin_next_file(&mut self, path: &Path) -> Beyond {
        self.name = path.display().to_string().into();
        match Input::open(path, false) {
            Ok(mut input) => {
                input.set_zone(self.input.zone().clone());
                self.head = head_of(&input);
                self.input = input;
                self.decoder.begin_next_file();
                self.ended = false;
                Beyond::Batch
            }
            Err(error) => {
                self.between_files = !self.others.is_empty();
                Beyond::Issue(self.issue(Place::Offset(0), Fault::Io(error)))
            }
        }
    }
}
