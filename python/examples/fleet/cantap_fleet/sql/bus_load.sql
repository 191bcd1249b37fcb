-- Bus load per vehicle, channel and hour.
--
-- How many stuff bits a frame has depends on its bits, so there are two figures: without any, and with the maximum. The true
-- load lies between them (`cantap stats` gives it exactly). Only the time covered by a trace counts: from its first to its last frame of the hour.
-- Frames that were lost and error frames are in neither figure. Without a bit rate in vehicles.csv there is no load.
WITH lengths AS (
    -- ISO 11898-1: a frame from its start to the end of the intermission. `head` is the stuffed part at the nominal bit rate, `body` that at
    -- the data bit rate; `plain` and `fast` are the parts that are never stuffed, including CAN FD's fixed stuff bits.
    SELECT
        vehicle, channel, trace, time, time_ns, fd, brs,
        CASE
            WHEN fd AND extended THEN 36
            WHEN fd THEN 17
            WHEN extended THEN 54
            ELSE 34
        END + CASE WHEN fd OR remote THEN 0 ELSE 8 * octet_length(data) END AS head,
        CASE WHEN fd THEN 5 + 8 * octet_length(data) ELSE 0 END AS body,
        CASE WHEN fd THEN 12 ELSE 13 END AS plain,
        CASE WHEN NOT fd THEN 0 WHEN octet_length(data) > 16 THEN 4 + 21 + 7 + 1 ELSE 4 + 17 + 6 + 1 END AS fast
    FROM frames
    WHERE event = 'frame'
),
rated AS (
    SELECT
        lengths.*,
        coalesce(own.bitrate, every.bitrate) AS bitrate,
        CASE
            WHEN NOT lengths.brs OR NOT lengths.fd THEN coalesce(own.bitrate, every.bitrate)
            ELSE coalesce(own.data_bitrate, every.data_bitrate)
        END AS data_bitrate
    FROM lengths
    LEFT JOIN vehicles AS own ON own.vehicle = lengths.vehicle AND own.channel = lengths.channel
    LEFT JOIN vehicles AS every ON every.vehicle = lengths.vehicle AND every.channel IS NULL
),
timed AS (
    SELECT
        vehicle, channel, trace, time, time_ns,
        (head + plain) / bitrate + (body + fast) / data_bitrate AS least_s,
        (head + plain + (head - 1) DIV 4) / bitrate
            + (body + fast + (head + body - 1) DIV 4 - (head - 1) DIV 4) / data_bitrate AS most_s
    FROM rated
),
per_trace AS (
    SELECT
        vehicle, channel, trace, date_trunc('HOUR', time) AS hour,
        count(*) AS frames,
        (max(time_ns) - min(time_ns)) / 1e9 AS recorded_s,
        -- A sum skips unknown values, but a single frame without a rate makes the load unknown.
        CASE WHEN count(least_s) = count(*) THEN sum(least_s) END AS least_s,
        CASE WHEN count(most_s) = count(*) THEN sum(most_s) END AS most_s
    FROM timed
    GROUP BY vehicle, channel, trace, date_trunc('HOUR', time)
)
SELECT
    vehicle, channel, hour,
    sum(frames) AS frames,
    sum(recorded_s) AS recorded_s,
    CASE WHEN count(least_s) = count(*) THEN try_divide(100 * sum(least_s), sum(recorded_s)) END AS load_at_least_pct,
    CASE WHEN count(most_s) = count(*) THEN try_divide(100 * sum(most_s), sum(recorded_s)) END AS load_at_most_pct
FROM per_trace
GROUP BY vehicle, channel, hour
ORDER BY vehicle, channel, hour
