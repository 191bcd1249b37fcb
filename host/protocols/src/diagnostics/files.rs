//! RequestFileTransfer: the content of its requests and responses, by mode of operation. The fields
//! are those of the Python package py-uds, with which a test compares them.

use super::cursor::Cursor;
use crate::Field;

const ADD: u8 = 1;
const DELETE: u8 = 2;
const REPLACE: u8 = 3;
const READ: u8 = 4;
const READ_FOLDER: u8 = 5;
const RESUME: u8 = 6;

/// The content of a request after the mode of operation.
pub fn request(mode: u8, cursor: &mut Cursor<'_, '_>) -> Option<()> {
    let length = cursor.take(2)?;
    let length = usize::from(u16::from_be_bytes([length[0], length[1]]));
    let Some(name) = cursor.take(length) else {
        cursor.push(Field::number("file_length", length as i64).unit("bytes"));
        return None;
    };
    cursor.push(Field::text("file", String::from_utf8_lossy(name).into_owned()));
    if matches!(mode, ADD | REPLACE | READ | RESUME) {
        cursor.hex("data_format", 1)?;
    }
    if matches!(mode, ADD | REPLACE | RESUME) {
        let each = usize::from(cursor.take(1)?[0]);
        cursor.number("size_uncompressed", each, "bytes")?;
        cursor.number("size_compressed", each, "bytes")?;
    }
    Some(())
}

/// The content of a positive response after the mode of operation.
pub fn response(mode: u8, cursor: &mut Cursor<'_, '_>) -> Option<()> {
    if mode == DELETE || !matches!(mode, ADD..=RESUME) {
        return None;
    }
    let length = usize::from(cursor.take(1)?[0]);
    cursor.number("block_length", length, "bytes")?;
    cursor.hex("data_format", 1)?;
    match mode {
        READ | READ_FOLDER => {
            let length = cursor.take(2)?;
            let length = usize::from(u16::from_be_bytes([length[0], length[1]]));
            if mode == READ_FOLDER {
                return cursor.number("folder_length", length, "bytes");
            }
            cursor.number("size_uncompressed", length, "bytes")?;
            cursor.number("size_compressed", length, "bytes")
        }
        RESUME => cursor.number("file_position", 8, "bytes"),
        _ => None,
    }
}
