// Memory of rollouts: chunks that go back to a pool instead of to the system, which would hand them out page by page again.
#pragma once

#include <atomic>
#include <cstdint>
#include <cstdlib>
#include <new>

#include "simd.h"

namespace CPDEFORM_ISA {

struct Chunk {
  Chunk* next;
  int64_t size;  // bytes behind the header
  int64_t used;
  char padding[64 - sizeof(Chunk*) - 2 * sizeof(int64_t)];
  char* bytes() { return reinterpret_cast<char*>(this) + sizeof(Chunk); }
};
static_assert(sizeof(Chunk) == 64);

class Pool {
 public:
  ~Pool() { clear(); }

  // Give what nobody uses back to the system.
  void clear() {
    lock();
    release(free_);
    free_ = nullptr;
    unlock();
  }

  Chunk* take(int64_t size) {
    lock();
    for (Chunk** at = &free_; *at; at = &(*at)->next) {
      Chunk* chunk = *at;
      if (chunk->size >= size && chunk->size <= size + size / 4) {
        *at = chunk->next;
        unlock();
        chunk->next = nullptr;
        chunk->used = 0;
        return chunk;
      }
    }
    unlock();
    void* memory = nullptr;
    if (posix_memalign(&memory, 64, size_t(size) + sizeof(Chunk)) != 0) throw std::bad_alloc();
    return new (memory) Chunk{nullptr, size, 0, {}};
  }

  void give(Chunk* chunk) {
    lock();
    chunk->next = free_;
    free_ = chunk;
    unlock();
  }

 private:
  static void release(Chunk* chunk) {
    while (chunk) {
      Chunk* next = chunk->next;
      std::free(chunk);
      chunk = next;
    }
  }
  void lock() {
    while (busy_.test_and_set(std::memory_order_acquire)) {
    }
  }
  void unlock() { busy_.clear(std::memory_order_release); }

  Chunk* free_ = nullptr;
  std::atomic_flag busy_ = ATOMIC_FLAG_INIT;
};

// Hands out 64-byte aligned memory that all goes back at once.
class Arena {
 public:
  static constexpr int64_t usual_chunk = 1 << 20;

  Arena() = default;
  Arena(const Arena&) = delete;
  Arena& operator=(const Arena&) = delete;
  ~Arena() { clear(); }
  void attach(Pool* pool) { pool_ = pool; }

  template <class T>
  T* take(int64_t count) {
    const int64_t size = (count * int64_t(sizeof(T)) + 63) / 64 * 64;
    if (!last_ || last_->size - last_->used < size) {
      Chunk* chunk = pool_->take(size > usual_chunk ? size : usual_chunk);
      chunk->next = last_;
      last_ = chunk;
    }
    T* result = reinterpret_cast<T*>(last_->bytes() + last_->used);
    last_->used += size;
    bytes_ += size;
    return result;
  }

  void clear() {
    while (last_) {
      Chunk* next = last_->next;
      pool_->give(last_);
      last_ = next;
    }
    bytes_ = 0;
  }
  int64_t bytes() const { return bytes_; }

 private:
  Pool* pool_ = nullptr;
  Chunk* last_ = nullptr;
  int64_t bytes_ = 0;
};

}  // namespace CPDEFORM_ISA
