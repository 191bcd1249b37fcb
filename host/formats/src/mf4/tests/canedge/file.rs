//! Whole files of groups, finished or not, sorted or not.

use super::super::super::encode::Blocks;
use super::super::{FILE_MAGIC, HEADER_AT, START_NS, UNFINISHED_MAGIC};
use super::group::Group;
use super::layouts::Frame;

/// How a logger leaves a file, and what its makers' program makes of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    /// Numbers of records and the length of the data are missing.
    Unfinished,
    Finished,
    /// Each group by itself, and its values in a stream.
    Sorted,
}

/// Arranges frames in groups.
pub type Layout = fn(&mut Blocks, &[Frame]) -> Vec<Group>;

/// A file of these frames.
pub fn file(layout: Layout, form: Form, frames: &[Frame]) -> Vec<u8> {
    let mut blocks = Blocks(vec![0; HEADER_AT as usize + 104]);
    let groups = layout(&mut blocks, frames);
    let comment = "<HDcomment><TX/><common_properties><tree name=\"Device Information\">\
                   <e name=\"serial number\" ro=\"true\">00000001</e></tree></common_properties></HDcomment>";
    let comment = blocks.text(*b"##MD", comment);
    let is_counted = form != Form::Unfinished;
    let mut next_data = 0;
    if form == Form::Sorted {
        for group in groups.iter().rev() {
            let values = if group.has_values() { blocks.push(*b"##SD", &[], &group.values) } else { 0 };
            let block = group.block(&mut blocks, 0, values, true);
            let data = blocks.push(*b"##DT", &[], &group.data);
            next_data = blocks.push(*b"##DG", &[next_data, block, data, 0], &[0; 8]);
        }
    } else {
        let mut next = 0;
        for group in groups.iter().rev() {
            let mut values = 0;
            if group.has_values() {
                let number = group.channels.iter().map(|channel| channel.values).max().unwrap();
                let mut data = u64::from(number).to_le_bytes().to_vec();
                data.extend(if is_counted { group.records } else { 0 }.to_le_bytes());
                data.extend([1, 0, 0, 0, 0, 0, 0, 0]);
                data.extend(if is_counted { group.values.len() as u64 } else { 0 }.to_le_bytes());
                next = blocks.push(*b"##CG", &[next, 0, 0, 0, 0, 0], &data);
                values = next;
            }
            next = group.block(&mut blocks, next, values, is_counted);
        }
        let mut rows: Vec<_> = groups.iter().flat_map(Group::rows).collect();
        rows.sort_by_key(|(us, _)| *us);
        let rows = rows.into_iter().map(|(_, row)| row).collect::<Vec<_>>().concat();
        let data_at = blocks.0.len() as u64 + 24 + 4 * 8 + 8;
        next_data = blocks.push(*b"##DG", &[0, next, data_at, 0], &[1, 0, 0, 0, 0, 0, 0, 0]);
        let len = if is_counted { 24 + rows.len() as u64 } else { 24 };
        blocks.0.extend([&b"##DT\0\0\0\0"[..], &len.to_le_bytes(), &[0; 8], &rows].concat());
    }
    let mut date = START_NS.to_le_bytes().to_vec();
    date.extend([0, 0, 0, 0, 2, 0, 0, 0]);
    date.resize(32, 0);
    let mut header = Blocks(Vec::new());
    header.push(*b"##HD", &[next_data, 0, 0, 0, 0, comment], &date);
    let mut file = blocks.0;
    file[HEADER_AT as usize..][..104].copy_from_slice(&header.0);
    file[..8].copy_from_slice(if is_counted { FILE_MAGIC } else { UNFINISHED_MAGIC });
    file[8..24].copy_from_slice(b"4.11    CE     \0");
    file[28..30].copy_from_slice(&411_u16.to_le_bytes());
    file[60..62].copy_from_slice(&(if is_counted { 0 } else { 0x25_u16 }).to_le_bytes());
    file
}
