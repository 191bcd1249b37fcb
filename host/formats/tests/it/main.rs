//! Every integration test of this crate, in one program: each program is linked on its own.

mod conversions_account_for_everything;
mod fd_frames_agree_with_peers;
mod formats_page;
mod no_line_is_lost_in_silence;
#[cfg(feature = "parquet")]
mod parquet;
mod peers;
mod trace_files_agree_with_peers;
#[cfg(feature = "zstd")]
mod trace_files_round_trip;
#[cfg(feature = "zstd")]
mod trace_files_survive_crashes;
#[cfg(feature = "zstd")]
mod trace_readers_take_anything;
mod traces;
