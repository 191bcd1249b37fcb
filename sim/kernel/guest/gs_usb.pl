#!/usr/bin/perl
# gs_usb.pl PORT FOLDER: a gs_usb adapter with two channels on one bus, exported by USB/IP, with candleLight's
# requests (`src/usbd_gs_can.c`). Frames that were sent come back once somebody acknowledged them, as CANnectivity's do; candleLight's come back at once.
#
# FOLDER/traffic: a number of frames, which every started channel then receives; they are appended to FOLDER/sent once all are on their way.
# FOLDER/error: the eight digits of an error frame's classes and its data, for the first channel.
# FOLDER/peer: while it is there, somebody else on the bus acknowledges frames.
# FOLDER/requests: each vendor request. FOLDER/listening: it can be attached.
use strict;
use warnings;
use Socket;

my ($port, $folder) = @ARGV;
my ($STALL, $RESET) = (-32, -104);
my ($LISTEN_ONLY, $STAMPS) = (1, 16);
# Listen-only, stamps, identify, termination, bus errors, state.
my $FEATURES = 0x3831;
my @STRINGS = ('stand-in', 'gs_usb', '0042');
my $DEVICE = pack 'C2 v C4 v3 C4', 18, 1, 0x200, 0, 0, 0, 64, 0x1d50, 0x606f, 1, 1, 2, 3, 1;
my $CONFIGURATION = pack('C2 v C5', 9, 2, 32, 1, 1, 0, 0x80, 50)
  . pack('C9', 9, 4, 0, 0, 2, 255, 255, 255, 0)
  . pack('C4 v C', 7, 5, 0x81, 2, 64, 0)
  . pack('C4 v C', 7, 5, 2, 2, 64, 0);

my $kernel;
# Reads that wait, transfers that wait for one, the flags of started channels, frames that nobody has acknowledged.
my (@reads, @transfers, %started, @held);
my ($traffic, $number) = (0, 0);

sub now_us {
  my $time = "\0" x 16;
  syscall 228, 1, $time;
  my ($seconds, $nanoseconds) = unpack 'q2', $time;
  return ($seconds * 1_000_000 + int($nanoseconds / 1000)) & 0xffffffff;
}

sub slurp {
  my ($name) = @_;
  open my $file, '<', "$folder/$name" or return;
  my $text = <$file>;
  close $file;
  # The shell opens a file before it writes the line.
  return unless defined $text && $text =~ /\n\z/;
  unlink "$folder/$name";
  return $text;
}

sub append {
  my ($name, $text) = @_;
  open my $file, '>>', "$folder/$name" or die $!;
  print $file $text;
  close $file;
}

sub receive {
  my ($length) = @_;
  my $bytes = '';
  while (length $bytes < $length) {
    sysread $kernel, $bytes, $length - length $bytes, length $bytes or die "the connection ended\n";
  }
  return $bytes;
}

sub give {
  my ($bytes) = @_;
  while (length $bytes) {
    my $written = syswrite $kernel, $bytes or die "the connection ended\n";
    substr $bytes, 0, $written, '';
  }
}

# An URB ends with a status, and with data if it was a read.
sub complete {
  my ($seq, $status, $actual, $data) = @_;
  give(pack('N12', 3, $seq, 0, 0, 0, $status & 0xffffffff, $actual, 0, 0, 0, 0, 0) . ($data // ''));
}

# A frame for the host: without its stamp as it was sent, or as it was received.
sub to_host {
  my ($frame) = @_;
  my $channel = unpack 'x9 C', $frame;
  $frame .= pack 'V', now_us() if ($started{$channel} // 0) & $STAMPS;
  push @transfers, $frame;
}

sub received_on {
  my ($channel, $frame) = @_;
  substr $frame, 0, 4, pack 'V', 0xffffffff;
  substr $frame, 9, 1, pack 'C', $channel;
  to_host($frame);
}

# On the bus, if anybody acknowledges.
sub on_the_bus {
  my ($frame) = @_;
  my $sender = unpack 'x9 C', $frame;
  return unless exists $started{$sender} && !($started{$sender} & $LISTEN_ONLY);
  my @others = grep { $_ != $sender } sort keys %started;
  unless (-e "$folder/peer" || grep { !($started{$_} & $LISTEN_ONLY) } @others) {
    push @held, $frame;
    return;
  }
  received_on($_, $frame) for @others;
  to_host($frame);
}

sub descriptor {
  my ($kind, $index) = @_;
  return $DEVICE if $kind == 1;
  return $CONFIGURATION if $kind == 2;
  return if $kind != 3 || $index > @STRINGS;
  my $string = $index ? pack 'v*', unpack 'C*', $STRINGS[$index - 1] : pack 'v', 0x409;
  return pack('C2', 2 + length $string, 3) . $string;
}

# The data of a request's answer, empty if it has none; nothing if it is refused.
sub control {
  my ($type, $request, $value, $data) = @_;
  return descriptor($value >> 8, $value & 255) if $type == 0x80 && $request == 6;
  return pack 'v', 0 if $type == 0x80 && $request == 0;
  return '' if $type < 3;
  append('requests', sprintf "%d %d %s\n", $request, $value, unpack 'H*', $data) if $type == 0x41;
  if ($type == 0x41 && $request == 2) {
    my ($mode, $flags) = unpack 'V2', $data;
    delete $started{$value};
    @held = grep { unpack('x9 C', $_) != $value } @held;
    $started{$value} = $flags if $mode;
    return '';
  }
  return '' if $type == 0x41 && grep { $request == $_ } 0, 1, 7, 12;
  return unless $type == 0xc1;
  return pack 'V10', $FEATURES, 48_000_000, 1, 16, 1, 8, 4, 1, 1024, 1 if $request == 4;
  # Two channels.
  return pack 'C4 V2', 0, 0, 0, 1, 2, 1 if $request == 5;
  return pack 'V', now_us() if $request == 6;
  return pack 'V3', 0, 0, 0 if $request == 14;
  return;
}

sub message {
  my ($command, $seq, undef, $is_in, $endpoint, $flags, $length, undef, undef, undef, $setup) =
    unpack 'N10 a8', receive(48);
  if ($command == 2) {
    my $victim = $flags;
    my $waiting = grep { $_->[0] == $victim } @reads;
    @reads = grep { $_->[0] != $victim } @reads;
    give(pack 'N12', 4, $seq, 0, 0, 0, ($waiting ? $RESET : 0) & 0xffffffff, 0, 0, 0, 0, 0, 0);
    return;
  }
  my $data = $is_in ? '' : receive($length);
  if ($endpoint == 0) {
    my ($type, $request, $value) = unpack 'C2 v', $setup;
    my $answer = control($type, $request, $value, $data);
    return complete($seq, $STALL, 0) unless defined $answer;
    return complete($seq, 0, $length) unless $is_in;
    $answer = substr $answer, 0, $length;
    complete($seq, 0, length $answer, $answer);
  } elsif ($is_in) {
    push @reads, [$seq];
  } else {
    complete($seq, 0, $length);
    on_the_bus(substr $data, 0, 20);
  }
}

sub pass_time {
  my $wanted = slurp('traffic');
  $traffic += $wanted if $wanted;
  my $log = '';
  while ($traffic && @transfers < 60) {
    my $id = $number * 7 & 0x7ff;
    my $frame = pack 'V2 C4 V2', 0, $id, 8, 0, 0, 0, $number, 0x55aa;
    received_on($_, $frame) for sort keys %started;
    $log .= sprintf "%03X#%s\n", $id, uc unpack 'H*', pack 'V2', $number, 0x55aa;
    $number++;
    $traffic--;
  }
  append('sent', $log) if $log;
  if (my $error = slurp('error')) {
    my ($classes, $data) = $error =~ /^(\w{8}) (\w{16})/;
    received_on(0, pack('V2 C4', 0, 0x20000000 | hex $classes, 8, 0, 0, 0) . pack 'H*', $data);
  }
  if (-e "$folder/peer" && @held) {
    my @waiting = splice @held;
    on_the_bus($_) for @waiting;
  }
  while (@reads && @transfers) {
    my $read = shift @reads;
    my $transfer = shift @transfers;
    complete($read->[0], 0, length $transfer, $transfer);
  }
}

sub session {
  my ($version, $code, $status) = unpack 'n2 N', receive(8);
  die "no import\n" if $code != 0x8003;
  receive(32);
  my $record = pack 'a256 a32 N3', '/sys/devices/stand-in', '1-1', 1, 3, 2;
  $record .= pack 'n3 C6', 0x1d50, 0x606f, 1, 0, 0, 0, 0, 1, 1;
  give(pack('n2 N', 0x0111, 3, 0) . $record);
  (@reads, @transfers, %started, @held) = ();
  while (1) {
    my $ready = '';
    vec($ready, fileno $kernel, 1) = 1;
    message() if select $ready, undef, undef, 0.01;
    pass_time();
  }
}

socket my $server, PF_INET, SOCK_STREAM, 0 or die $!;
setsockopt $server, SOL_SOCKET, SO_REUSEADDR, 1;
bind $server, sockaddr_in($port, INADDR_LOOPBACK) or die $!;
listen $server, 1 or die $!;
append('listening', '');
while (accept $kernel, $server) {
  setsockopt $kernel, Socket::IPPROTO_TCP(), Socket::TCP_NODELAY(), 1;
  eval { session(); };
  print STDERR $@;
  close $kernel;
}
