"""cantools reads a database without a warning, and decodes every frame of a candump log with it: frames and messages are counted."""
import sys
import warnings

warnings.simplefilter("error")
import cantools  # noqa: E402

database = cantools.database.load_file(sys.argv[1], strict=True)
frames, messages = 0, set()
with open(sys.argv[2], encoding="ascii") as log:
    for line in log:
        identifier, data = line.split()[2].split("#")
        frame_id, data = int(identifier, 16), bytes.fromhex(data)
        message = database.get_message_by_frame_id(frame_id)
        assert message.is_extended_frame == (len(identifier) == 8), line
        assert len(data) == message.length, line
        values = message.decode(data, decode_choices=False)
        for signal in message.signals:
            if signal.name in values:
                value = values[signal.name]
                assert signal.minimum - 1e-9 <= value <= signal.maximum + 1e-9, f"{signal.name} is {value}: {line}"
                assert not signal.choices or value in signal.choices, f"{signal.name} has no name for {value}"
        frames += 1
        messages.add(message.name)
print(frames, len(messages))
