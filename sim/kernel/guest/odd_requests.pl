# odd_requests.pl DEVICE: requests through usbfs that no driver makes. Each must be answered as USB 2.0, chapter 9, requires: with these bytes
# or with a stall, and the device must carry on.
use strict;
use warnings;

# From the kernel's usbdevice_fs.h: a request, its data behind a pointer, and how long to wait.
my $USBDEVFS_CONTROL = 0xC0185500;
my $TIMEOUT_MS = 2000;

open(my $device, '+<', $ARGV[0]) or die "$ARGV[0]: $!";

sub request {
    my ($kind, $request, $value, $index, $length) = @_;
    my $data = "\0" x ($length || 1);
    my $transfer = pack('CCSSSLx4P', $kind, $request, $value, $index, $length, $TIMEOUT_MS, $data);
    my $moved = ioctl($device, $USBDEVFS_CONTROL, $transfer);
    return defined $moved ? unpack('H*', substr($data, 0, $moved)) : $!{EPIPE} ? 'stall' : "$!";
}

my $bad = 0;
sub expect {
    my ($what, $wanted, @request) = @_;
    my $got = request(@request);
    return if $got eq $wanted;
    print "      $what: $got, not $wanted\n";
    $bad = 1;
}

expect('GET_STATUS', '0000', 0x80, 0, 0, 0, 2);
expect('GET_CONFIGURATION', '01', 0x80, 8, 0, 0, 1);
expect('a descriptor that only classes have', 'stall', 0x80, 6, 0x2100, 0, 9);
expect('a string that is not there', 'stall', 0x80, 6, 0x03EE, 0, 18);
expect('a device qualifier at full speed', 'stall', 0x80, 6, 0x0600, 0, 10);
expect('a vendor request that reads', 'stall', 0xC0, 1, 0, 0, 8);
expect('a vendor request', 'stall', 0x40, 1, 0, 0, 0);
expect('TEST_MODE', 'stall', 0x00, 3, 2, 0x0100, 0);
expect('a configuration that is not there', 'stall', 0x00, 9, 7, 0, 0);
expect('remote wakeup, which bmAttributes denies', 'stall', 0x00, 3, 1, 0, 0);
expect('GET_STATUS at the end', '0000', 0x80, 0, 0, 0, 2);
exit $bad;
