//! Every integration test of this crate, in one program: each program is linked on its own.

#[cfg(unix)]
mod adapters;
mod align;
mod analysis;
mod bit_rate_auto;
mod boards;
mod bus_commands;
mod canopen_ends;
mod capture_and_demo;
mod capture_rotates;
mod car;
mod closed_output;
mod columns;
#[cfg(feature = "emu")]
#[path = "../../../sim/tests/it/common/mod.rs"]
mod common;
#[cfg(unix)]
mod compare_adapters;
mod completion;
mod conversations;
mod convert;
mod db;
mod decode;
mod defaults;
mod device_care;
mod device_time;
mod diagnostics;
mod disturb;
mod doctor;
mod drive;
mod emulated;
mod emulated_autobaud;
mod emulated_clock;
mod extcap;
#[allow(dead_code, reason = "the library's tests use the rest of it")]
#[path = "../../../host/tests/it/fake_device/mod.rs"]
mod fake_device;
mod firmware;
mod follow;
mod gateway;
mod habits;
mod help;
mod in_folder;
mod json_schema;
#[cfg(target_os = "linux")]
mod list;
#[cfg(unix)]
mod marine;
mod mcap;
mod message_names;
mod misbehaving_devices;
mod monitor_keys;
mod monitor_obd;
mod monitor_replug;
mod monitor_screens;
mod monitor_scripts;
mod monitor_sources;
mod monitor_terminal;
mod nodes;
mod nothing_read;
mod odx;
mod outputs;
mod port;
mod protocols;
mod python_can;
mod ranges;
mod readme;
mod ready_nodes;
mod report;
mod schema;
mod scripts;
mod search_and_diff;
mod selftest;
mod send_signals;
mod serve;
mod serve_far;
mod serve_lab;
mod serve_web;
mod served;
mod shell;
mod speaking_ends;
mod terminal;
mod texts_from_outside;
mod timing;
mod trigger;
mod tutorial;
mod twin;
mod two_testers;
mod ui;
mod unsent;
mod virtual_canopen;
mod vocabulary;
mod xcp;
