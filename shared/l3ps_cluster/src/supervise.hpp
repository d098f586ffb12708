// Work without the interpreter's lock that Python can still stop.
#pragma once

#include <nanobind/nanobind.h>

#include <chrono>
#include <condition_variable>
#include <functional>

#include "parallel.hpp"

namespace l3ps {

// Runs the work in a thread of its own; this one, every 50 ms, lets Python handle signals and calls `cancel`. When
// either raises, the work is told to stop, and the exception goes on once it has.
inline void supervise(Team& team, const nanobind::object& cancel, const std::function<void()>& work) {
    std::mutex guard;
    std::condition_variable ended;
    bool done = false;
    std::exception_ptr failure, raised;
    {
        const nanobind::gil_scoped_release release;
        std::thread worker([&] {
            try {
                work();
            } catch (...) {
                failure = std::current_exception();
            }
            const std::lock_guard<std::mutex> hold(guard);
            done = true;
            ended.notify_all();
        });
        std::unique_lock<std::mutex> hold(guard);
        while (!ended.wait_for(hold, std::chrono::milliseconds(50), [&] { return done; })) {
            if (raised) continue;
            hold.unlock();
            {
                const nanobind::gil_scoped_acquire acquire;
                try {
                    if (PyErr_CheckSignals() != 0) throw nanobind::python_error();
                    if (!cancel.is_none()) cancel();
                } catch (...) {
                    raised = std::current_exception();
                    team.stop();
                }
            }
            hold.lock();
        }
        hold.unlock();
        worker.join();
    }
    if (raised) std::rethrow_exception(raised);
    if (failure) std::rethrow_exception(failure);
}

}  // namespace l3ps
