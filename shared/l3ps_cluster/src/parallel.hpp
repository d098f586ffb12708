// Threads that live for one call, and the flag that stops them.
//
// No pool is kept: a prefork worker's child may not inherit one, and starting a thread (20 µs) costs nothing beside
// the loops it runs.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <exception>
#include <mutex>
#include <thread>
#include <vector>

namespace l3ps {

struct Stopped : std::exception {
    const char* what() const noexcept override { return "stopped"; }
};

class Team {
public:
    explicit Team(int threads) : threads_(std::max(threads, 1)) {}

    int threads() const { return threads_; }
    void stop() { stop_.store(true, std::memory_order_relaxed); }
    void check() const {
        if (stop_.load(std::memory_order_relaxed)) throw Stopped();
    }

    // work(begin, end) over chunks of [0, count); which thread takes which chunk is open, so work on different chunks
    // must not depend on each other.
    template <typename Work>
    void over(std::size_t count, std::size_t chunk, Work&& work) {
        std::atomic<std::size_t> next{0};
        run_on(std::min<std::size_t>(threads_, (count + chunk - 1) / chunk), [&] {
            for (;;) {
                check();
                const std::size_t begin = next.fetch_add(chunk, std::memory_order_relaxed);
                if (begin >= count) return;
                work(begin, std::min(begin + chunk, count));
            }
        });
    }

private:
    // The same body on several threads, this one included; the first exception stops the others and is thrown here.
    template <typename Body>
    void run_on(std::size_t count, Body&& body) {
        if (count <= 1) return body();
        std::exception_ptr failure;
        std::mutex guard;
        const auto guarded = [&] {
            try {
                body();
            } catch (...) {
                const std::lock_guard<std::mutex> hold(guard);
                if (!failure) failure = std::current_exception();
                stop();
            }
        };
        std::vector<std::thread> others;
        others.reserve(count - 1);
        try {
            while (others.size() + 1 < count) others.emplace_back(guarded);
        } catch (const std::system_error&) {
            // No more threads to be had: those that started, and this one, do the work.
        }
        guarded();
        for (std::thread& other : others) other.join();
        if (failure) std::rethrow_exception(failure);
    }

    int threads_;
    std::atomic<bool> stop_{false};
};

}  // namespace l3ps
