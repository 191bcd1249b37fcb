-- The worst period jitter of each identifier over the fleet, and where that was.
--
-- Jitter is the standard deviation of the periods of an identifier in one trace, as in `cantap stats`. Across a loss there is no period.
-- Traces with places that could not be read are left out: such a place looks like a long period.
WITH numbered AS (
    SELECT *, count_if(event = 'lost') OVER (PARTITION BY trace, channel ORDER BY row) AS losses
    FROM frames
    WHERE trace IN (SELECT trace FROM ledger WHERE state IN ('read', 'undecoded', 'cut'))
),
periods AS (
    SELECT
        vehicle, trace, channel, id, extended, time,
        time_ns - lag(time_ns) OVER (PARTITION BY trace, channel, id, extended, losses ORDER BY row) AS period_ns
    FROM numbered
    WHERE event = 'frame'
),
measured AS (
    SELECT
        vehicle, trace, channel, id, extended,
        count(period_ns) AS periods,
        avg(period_ns) / 1e6 AS mean_ms,
        stddev_pop(period_ns) / 1e6 AS jitter_ms,
        max(period_ns) / 1e6 AS longest_ms,
        max_by(time, period_ns) AS longest_until
    FROM periods
    GROUP BY vehicle, trace, channel, id, extended
    HAVING count(period_ns) >= 2
),
ranked AS (
    SELECT *, row_number() OVER (PARTITION BY id, extended ORDER BY jitter_ms DESC, trace, channel) AS place
    FROM measured
)
SELECT id, extended, jitter_ms, mean_ms, longest_ms, longest_until, periods, vehicle, trace, channel
FROM ranked
WHERE place = 1
ORDER BY jitter_ms DESC, id, extended
