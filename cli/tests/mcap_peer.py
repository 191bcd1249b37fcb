"""An MCAP file as its own library reads it, by the index and, if asked, in order; the result is printed as JSON."""

import json
import sys

from mcap.reader import NonSeekingReader, SeekingReader

path = sys.argv[1]
found = {"topics": {}, "schemas": {}, "messages": [], "in_order": 0}
with open(path, "rb") as file:
    reader = SeekingReader(file, validate_crcs=True)
    summary = reader.get_summary()
    statistics = summary.statistics
    found["statistics"] = {
        "messages": statistics.message_count,
        "chunks": statistics.chunk_count,
        "start": statistics.message_start_time,
        "end": statistics.message_end_time,
        "counts": {summary.channels[id].topic: count for id, count in statistics.channel_message_counts.items()},
    }
    for channel in summary.channels.values():
        schema = summary.schemas[channel.schema_id]
        found["topics"][channel.topic] = [channel.message_encoding, schema.name, channel.metadata]
        found["schemas"][schema.name] = [schema.encoding, json.loads(schema.data)]
    for _, channel, message in reader.iter_messages(log_time_order=False):
        assert message.log_time == message.publish_time
        found["messages"].append([channel.topic, message.sequence, message.log_time, json.loads(message.data)])
with open(path, "rb") as file:
    found["in_order"] = sum(1 for _ in NonSeekingReader(file, validate_crcs=True).iter_messages())
json.dump(found, sys.stdout)
